"""Q-learning on the map MDP: environment steps per second, with a gradient step per vector step."""

import dataclasses

import jax
import jax.numpy as jnp

from benchmarks import measure, peers
from benchmarks.maps import MODALITY, Task, untrained_task
from benchmarks.measure import Options, Row, Side
from jaxsense import PRESETS, make_mdp
from jaxsense.config import DqnConfig
from jaxsense.dqn import training
from jaxsense.dqn.map_mdp import MapMdp

_UNIT = "env-steps/s"


def dqn_rejax(options: Options) -> Row:
    """Against rejax, with as many environments and the same batch, network and replay."""
    task = untrained_task(_settings(options))
    peer = peers.load("rejax", options)
    theirs = [peer.throughput(task, options)] if peer else []
    return measure.compare(
        "dqn_rejax",
        _UNIT,
        [_our_side(task, task.mdp)],
        theirs,
        options,
        peer="rejax DQN",
        packages=("rejax",),
    )


def dqn_sb3(options: Options) -> Row:
    """Against Stable-Baselines3, which steps one environment in NumPy."""
    task = untrained_task(_settings(options))
    peer = peers.load("sb3", options)
    theirs = peer.throughputs(task, options) if peer else []
    return measure.compare(
        "dqn_sb3",
        _UNIT,
        [_our_side(task, task.mdp)],
        theirs,
        options,
        peer="Stable-Baselines3 DQN",
        packages=("stable-baselines3", "torch"),
    )


def dqn_live(options: Options) -> Row:
    """With a scan cast in each environment's own arena at every step."""
    task = untrained_task(_settings(options, epochs=100))
    mdp = make_mdp(task.config, task.models).map
    return measure.compare("dqn_live", _UNIT, [_our_side(task, mdp)], [], options)


def dqn_seeds(options: Options) -> Row:
    """Many seeds of the agents of both modalities in one program, with the paper's settings."""
    task = untrained_task(_settings(options))
    is_accelerated = jax.default_backend() != "cpu"
    num_seeds = 64 if is_accelerated and not options.quick else 2
    if not options.quick:
        paper = PRESETS["paper"].dqn
        # On a CPU a twentieth of the epochs: the rate is the same.
        epochs = paper.epochs if is_accelerated else paper.epochs // 20
        task = untrained_task(dataclasses.replace(paper, epochs=epochs))
    settings, modalities = task.config.dqn, jnp.arange(len(task.config.modalities))
    agent = task.models.agent

    def train(keys: jax.Array, mdp: MapMdp):
        def of_one(key: jax.Array, modality: jax.Array):
            return training.train(key, agent.environment(mdp, modality), settings)

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
    if options.quick:
        return DqnConfig(
            observe="bank",
            num_envs=16,
            epochs=4,
            chunk=2,
            updates=1,
            batch=16,
            replay_capacity=1024,
            num_starts=16,
        )
    return DqnConfig(
        observe="bank",
        num_envs=512,
        epochs=epochs,
        chunk=100,
        updates=1,
        batch=512,
        replay_capacity=131072,
    )


def _our_side(task: Task, mdp: MapMdp) -> Side:
    settings = task.config.dqn

    def train(key: jax.Array, mdp: MapMdp):
        return training.train(key, task.models.agent.environment(mdp, MODALITY), settings)

    work = settings.epochs * settings.num_envs
    return measure.compiled(train, jax.random.key(2), mdp, work=work, batch=settings.num_envs)
