"""rejax's DQN on the map MDP."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from flax import linen as nn
from flax import struct
from gymnax.environments import spaces  # pyright: ignore[reportMissingImports]
from rejax import DQN  # pyright: ignore[reportMissingImports]
from rejax.networks import (  # pyright: ignore[reportMissingImports]
    DiscreteQNetwork,
    EpsilonGreedyPolicy,
)

from benchmarks.maps import MODALITY, Learner, Task
from benchmarks.measure import Options, Side
from jaxsense.dqn import belief_mdp
from jaxsense.dqn.belief_mdp import MapState
from jaxsense.networks import Params


@struct.dataclass
class MapParams:
    """What the environment is given in each call.

    Attributes:
      params: of the JMVAE.
      bank: stored detections.
      starts: `[S]` states, of which a random one follows the end of an episode, as in our own
        training: to prepare a start in every step would cost far more than the step.
      max_steps_in_episode: rejax's name of `mdp.max_steps`.
    """

    params: Params
    bank: Any
    starts: MapState
    max_steps_in_episode: int = struct.field(pytree_node=False)


class MapEnv:
    """The map MDP behind gymnax's interface of five values, which rejax 0.1.3 expects."""

    default_params = None

    def __init__(self, task: Task):
        self._mdp_of = task.mdp_of
        self._num_actions = task.config.arena.num_pois + 1
        latent_size = task.config.jmvae.latent_size
        self._num_observations = 2 * latent_size * task.config.arena.num_pois

    def __deepcopy__(self, memo: dict) -> "MapEnv":
        """Itself, since it never changes: rejax copies its configuration."""
        return self

    def reset(self, key: jax.Array, params: MapParams) -> tuple[jax.Array, MapState]:
        """A random start."""
        row = jax.random.randint(key, (), 0, params.starts.steps.shape[0])
        state = jax.tree.map(lambda x: x[row], params.starts)
        return belief_mdp.as_state(state.belief), state

    def step(self, key: jax.Array, state: MapState, action: jax.Array, params: MapParams):
        """One action; an episode that ends is followed by the next."""
        step_key, reset_key = jax.random.split(key)
        mdp = self._mdp_of(params.params, params.bank)
        after, outcome = belief_mdp.step(step_key, mdp, state, action, MODALITY)
        done = outcome.is_over | outcome.is_cut
        _, start = self.reset(reset_key, params)
        after = jax.tree.map(lambda new, old: jnp.where(done, new, old), start, after)
        return belief_mdp.as_state(after.belief), after, outcome.reward, done, {}

    def action_space(self, params: MapParams | None = None) -> spaces.Discrete:
        """PoIs and NOP."""
        return spaces.Discrete(self._num_actions)

    def observation_space(self, params: MapParams | None = None) -> spaces.Box:
        """The map."""
        return spaces.Box(-jnp.inf, jnp.inf, (self._num_observations,), jnp.float32)


@dataclasses.dataclass(frozen=True)
class Settings:
    """What rejax is told; its names in brackets.

    Attributes:
      updates: gradient steps for each step of all environments [num_epochs].
      batch: transitions of one of them.
      replay: transitions that are kept; rejax sorts all of them to draw a batch.
      total: environment steps after which exploration has fallen to its floor, times 10.
      target_period: environment steps between two copies to the target network.
    """

    updates: int
    batch: int
    replay: int
    total: int
    target_period: int


def make(task: Task, settings: Settings) -> Any:
    """The algorithm with our network, learning rate, discount and number of environments."""
    dqn = task.config.dqn
    keys = jax.random.split(jax.random.key(3), dqn.num_starts)
    starts = jax.jit(jax.vmap(lambda key: belief_mdp.reset(key, task.mdp)))(keys)
    env = MapEnv(task)
    algorithm = DQN.create(  # pyright: ignore[reportAttributeAccessIssue]
        env=env,
        env_params=MapParams(task.params, task.bank, starts, task.config.mdp.max_steps),
        num_envs=dqn.num_envs,
        batch_size=settings.batch,
        num_epochs=settings.updates,
        buffer_size=settings.replay,
        fill_buffer=settings.batch,
        total_timesteps=settings.total,
        target_update_freq=settings.target_period,
        polyak=0.0,
        learning_rate=dqn.learning_rate,
        gamma=dqn.discount,
        ddqn=False,
        eps_end=dqn.epsilon_min,
    )
    # Its configuration has no place for the sizes of the layers.
    network = EpsilonGreedyPolicy(DiscreteQNetwork)(  # pyright: ignore[reportArgumentType]
        hidden_layer_sizes=dqn.hidden, activation=nn.relu, action_dim=env.action_space().n
    )
    return algorithm.replace(agent=network)


def iterate(algorithm: Any, state: Any, number: int) -> Any:
    """Some steps of all environments, each with its gradient steps; to be jitted."""
    return jax.lax.fori_loop(0, number, lambda _, s: algorithm.train_iteration(s), state)


def throughput(task: Task, options: Options) -> Side:
    """Its speed with the same environments, batch, gradient steps and replay."""
    dqn = task.config.dqn
    number = 2 if options.quick else 100
    settings = Settings(dqn.updates, dqn.batch, dqn.replay_capacity, 1_000_000, 25_000)
    algorithm = make(task, settings)
    state = jax.jit(algorithm.init_state)(jax.random.key(4))
    go_on = jax.jit(lambda state: iterate(algorithm, state, number))
    return Side(lambda: jax.block_until_ready(go_on(state)), number * dqn.num_envs, dqn.num_envs)


FAST = (
    Settings(updates=8, batch=256, replay=16384, total=400_000, target_period=5120),
    Settings(updates=16, batch=256, replay=8192, total=400_000, target_period=5120),
    Settings(updates=4, batch=256, replay=16384, total=400_000, target_period=5120),
)
"""Good settings for a short training, of which the best counts."""


def learner(task: Task, settings: Settings) -> Learner:
    """Its training, in chunks of as many steps as ours."""
    algorithm = make(task, settings)
    start = jax.jit(algorithm.init_state)
    return Learner(
        start=lambda: start(jax.random.key(8)),
        go_on=jax.jit(
            lambda state: iterate(algorithm, state, task.config.dqn.chunk), donate_argnums=0
        ),
        # The layers have the same names as ours.
        as_params=lambda state: state.q_ts.params,
    )
