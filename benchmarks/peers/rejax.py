"""rejax's DQN on the map MDP."""

import dataclasses
from typing import Any

import jax
from flax import linen as nn
from rejax import DQN  # pyright: ignore[reportMissingImports]
from rejax.networks import (  # pyright: ignore[reportMissingImports]
    DiscreteQNetwork,
    EpsilonGreedyPolicy,
)

from benchmarks.maps import MODALITY, Learner, Task
from benchmarks.measure import Options, Side
from jaxsense.interfaces.rejax import MapEnv


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
    env = MapEnv(task.mdp, MODALITY)
    algorithm = DQN.create(  # pyright: ignore[reportAttributeAccessIssue]
        env=env,
        # As in our own training: to make a start in every step would cost far more than the step.
        env_params=env.prepared_params(jax.random.key(3), dqn.num_starts),
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
