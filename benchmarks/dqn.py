"""Q-learning: environment steps per second of one robot, and our DQN as a learner in tasks."""

import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jax.tree_util import Partial

from benchmarks import measure, peers
from benchmarks.jmvae import random_bank
from benchmarks.measure import Options, Row, Side
from jaxsense import PRESETS, Bank, Config, Models, init, make_jmvae, make_mdp, tasks
from jaxsense.config import DqnConfig
from jaxsense.core.networks import Params
from jaxsense.core.types import Key
from jaxsense.dqn import Agent, Environment, Mdp, training
from jaxsense.dqn.policies import best
from jaxsense.run import devices
from jaxsense.tasks.score import Policy

MODALITY = 0
"""The agent looks with the camera."""
NUM_STARTS = 2048
"""Prepared starts of episodes, as many as our own learner with its 128 environments has: a new one
in each step would cost more than the step."""
_UNIT = "env-steps/s"


@dataclasses.dataclass(frozen=True, eq=False)
class Task:
    """Q-learning on the map MDP with stored detections.

    Attributes:
      config: all settings, including our own DQN's.
      models: the networks.
      bank: for each modality `[C, S, D_m]` detections.
    """

    config: Config
    models: Models
    bank: tuple[jax.Array, ...]

    @property
    def mdp(self) -> Mdp:
        """The MDP."""
        return make_mdp(self.config, self.models, Bank(self.bank)).of(MODALITY)

    @property
    def environment(self) -> Environment:
        """What our DQN learns in."""
        return Environment(self.models.agent, self.mdp)


@dataclasses.dataclass(frozen=True)
class Dqn:
    """`jaxsense.dqn.train` as a learner in tasks, with the network of the preset.

    Attributes:
      discount: of a step.
      discount_of_a_second: in place of that of a step, in a team.
      updates: gradient steps for each step of all environments.
      replay: transitions.
      exploration: share of the training until a hundredth of the first exploration is left.
      target_period: steps of all environments.
    """

    name = "our DQN"
    packages = ()
    discount: float = 0.5
    discount_of_a_second: float = 0.99
    num_envs: int = 128
    updates: int = 8
    batch: int = 256
    replay: int = 65536
    learning_rate: float = 1e-3
    exploration: float = 0.5
    target_period: int = 20

    def train(self, task: tasks.Task, seeds: Sequence[int], steps: int) -> dict[int, Policy]:
        """Trains all seeds in one program."""
        agent = task.models.agent
        discount = self.discount if agent.travel is None else self.discount_of_a_second
        agent = dataclasses.replace(agent, discount=discount)
        epochs = max(1, steps // self.num_envs)
        epochs -= epochs % 100 if epochs > 100 else 0
        settings = DqnConfig(
            num_envs=self.num_envs,
            epochs=epochs,
            updates=self.updates,
            batch=self.batch,
            replay_capacity=self.replay,
            learning_rate=self.learning_rate,
            epsilon_decay=0.01 ** (1 / (self.exploration * epochs)),
            target_period=self.target_period,
        )

        def train(key: Key, task: tasks.Task) -> Params:
            return training.train(key, Environment(agent, task.mdp), settings)[0].params

        options = devices.compiler_options(runs_long=True)
        of_seeds = jax.jit(jax.vmap(train, (0, None)), compiler_options=options)
        params = jax.device_get(of_seeds(jax.vmap(jax.random.key)(jnp.array(seeds)), task))
        return {
            seed: Partial(_act, task, agent, jax.tree.map(lambda x: x[i], params))  # noqa: B023
            for i, seed in enumerate(seeds)
        }


def _act(
    task: tasks.Task, agent: Agent, params: Params, key: Key, observation: jax.Array
) -> jax.Array:
    """The action of the highest Q-value, from an observation of a task."""
    del key
    known = task.scaling.inverse(observation)
    if task.mdp.teams is not None:
        # Networks ask whether a PoI's presence is above 0, which rounding must not decide.
        known = known.T.at[-3].set(jnp.round(known.T[-3]))
    return best(agent.values(params, known.reshape(-1)))


def untrained_task(dqn: DqnConfig, samples: int = 10000) -> Task:
    """A task of the real sizes with random networks and detections: as fast as a trained one.

    Args:
      dqn: settings of our own DQN.
      samples: detections of each class by each sensor.
    """
    config = dataclasses.replace(PRESETS["default"], dqn=dqn)
    sizes = make_jmvae(config).feature_sizes
    bank = random_bank(jax.random.key(1), sizes, len(config.arena.classes), samples)
    return Task(config, init(jax.random.key(0), config), bank)


def dqn_rejax(options: Options) -> Row:
    """Against rejax, with as many environments and the same batch, network and replay."""
    task, peer = untrained_task(_settings(options)), peers.load("rejax", options.peers)
    theirs = [peer.throughput(task, options)] if peer else []
    names = {"peer": "rejax DQN", "packages": ("rejax",)}
    ours = [_our_side(task, task.mdp)]
    return measure.compare("dqn_rejax", _UNIT, ours, theirs, options, **names)


def dqn_sb3(options: Options) -> Row:
    """Against Stable-Baselines3, which steps one environment in NumPy."""
    task, peer = untrained_task(_settings(options)), peers.load("sb3", options.peers)
    theirs = peer.throughputs(task, options) if peer else []
    names = {"peer": "Stable-Baselines3 DQN", "packages": ("stable-baselines3", "torch")}
    ours = [_our_side(task, task.mdp)]
    return measure.compare("dqn_sb3", _UNIT, ours, theirs, options, **names)


def dqn_live(options: Options) -> Row:
    """With a scan cast in each environment's own arena at every step."""
    task = untrained_task(_settings(options, epochs=100))
    mdp = make_mdp(task.config, task.models).of(MODALITY)
    return measure.compare("dqn_live", _UNIT, [_our_side(task, mdp)], [], options)


def dqn_seeds(options: Options) -> Row:
    """Many seeds of the agents of both modalities in one program, with the paper's settings."""
    settings, is_accelerated = _settings(options), jax.default_backend() != "cpu"
    if not options.quick:
        settings = PRESETS["paper"].dqn
        # On a CPU a twentieth of the epochs: the rate is the same.
        epochs = settings.epochs // (1 if is_accelerated else 20)
        settings = dataclasses.replace(settings, epochs=epochs)
    task = untrained_task(settings)
    num_seeds = 64 if is_accelerated and not options.quick else 2
    modalities, agent = jnp.arange(len(task.config.modalities)), task.models.agent

    def train(keys: jax.Array, mdp: Mdp):
        def of_one(key: jax.Array, modality: jax.Array):
            return training.train(key, Environment(agent, mdp.of(modality)), settings)

        of_seeds = jax.vmap(of_one, (0, None))
        state, infos = jax.vmap(of_seeds, (None, 0))(keys, modalities)
        return state.params, infos

    agents = num_seeds * len(modalities)
    work = agents * settings.epochs * settings.num_envs
    keys = jax.random.split(jax.random.key(3), num_seeds)
    side = measure.compiled(train, keys, task.mdp, work=work, batch=agents)
    return measure.compare("dqn_seeds", _UNIT, [side], [], options, repeats=1)


def _settings(options: Options, epochs: int = 400) -> DqnConfig:
    """512 environments, one gradient step of batch 512 for each step of all of them."""
    settings = DqnConfig(task="map", num_envs=512, epochs=epochs, updates=1)
    settings = dataclasses.replace(settings, batch=512, replay_capacity=131072)
    if options.quick:
        few = {"num_envs": 16, "batch": 16, "replay_capacity": 1024}
        settings = dataclasses.replace(settings, **few, epochs=4)
    return settings


def _our_side(task: Task, mdp: Mdp) -> Side:
    settings = task.config.dqn

    def train(key: jax.Array, mdp: Mdp):
        return training.train(key, Environment(task.models.agent, mdp), settings)

    work = settings.epochs * settings.num_envs
    return measure.compiled(train, jax.random.key(2), mdp, work=work, batch=settings.num_envs)
