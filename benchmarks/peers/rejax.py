"""rejax's DQN on the map MDP."""

import dataclasses
from typing import Any

import jax
from flax import linen as nn
from rejax.networks import (  # pyright: ignore[reportMissingImports]
    DiscreteQNetwork,
    EpsilonGreedyPolicy,
)

from benchmarks.maps import MODALITY, Learner, Task
from benchmarks.measure import Options, Side
from benchmarks.tasks.rejax import RejaxDqn, iterate
from jaxsense.interfaces.rejax import MapEnv


def make(task: Task, settings: RejaxDqn, steps: int) -> Any:
    """The algorithm with our network, learning rate, discount and number of environments.

    Args:
      task: what to learn.
      settings: the other settings.
      steps: environment steps after which exploration has fallen to its floor.
    """
    dqn = task.config.dqn
    env = MapEnv(task.mdp, MODALITY)
    same = dataclasses.replace(
        settings,
        discount=dqn.discount,
        num_envs=dqn.num_envs,
        learning_rate=dqn.learning_rate,
        exploration=1.0,
    )
    algorithm = same.make(
        steps,
        env=env,
        # As in our own training: to make a start in every step would cost far more than the step.
        env_params=env.prepared_params(jax.random.key(3), dqn.num_starts),
        fill_buffer=settings.batch,
        ddqn=False,
        eps_end=dqn.epsilon_min,
    )
    # Its configuration has no place for the sizes of the layers.
    network = EpsilonGreedyPolicy(DiscreteQNetwork)(  # pyright: ignore[reportArgumentType]
        hidden_layer_sizes=dqn.hidden, activation=nn.relu, action_dim=env.action_space().n
    )
    return algorithm.replace(agent=network)


def throughput(task: Task, options: Options) -> Side:
    """Its speed with the same environments, batch, gradient steps and replay."""
    dqn = task.config.dqn
    number = 2 if options.quick else 100
    settings = RejaxDqn(
        updates=dqn.updates, batch=dqn.batch, replay=dqn.replay_capacity, target_period=25_000
    )
    algorithm = make(task, settings, steps=100_000)
    state = jax.jit(algorithm.init_state)(jax.random.key(4))
    go_on = jax.jit(lambda state: iterate(algorithm, state, number))
    return Side(lambda: jax.block_until_ready(go_on(state)), number * dqn.num_envs, dqn.num_envs)


FAST = (
    RejaxDqn(updates=8, batch=256, replay=16384, target_period=5120),
    RejaxDqn(updates=16, batch=256, replay=8192, target_period=5120),
    RejaxDqn(updates=4, batch=256, replay=16384, target_period=5120),
)
"""Good settings for a short training, of which the best counts."""


def learner(task: Task, settings: RejaxDqn) -> Learner:
    """Its training, in chunks of as many steps as ours."""
    algorithm = make(task, settings, steps=40_000)
    start = jax.jit(algorithm.init_state)
    return Learner(
        start=lambda: start(jax.random.key(8)),
        go_on=jax.jit(
            lambda state: iterate(algorithm, state, task.config.dqn.chunk), donate_argnums=0
        ),
        # The layers have the same names as ours.
        as_params=lambda state: state.q_ts.params,
    )
