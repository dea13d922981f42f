"""rejax: its DQN on the map MDP, and DQN and PPO as learners in tasks."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import rejax  # pyright: ignore[reportMissingImports]
from flax import linen as nn
from jax.tree_util import Partial
from jaxtyping import PyTree
from rejax.networks import (  # pyright: ignore[reportMissingImports]
    DiscreteQNetwork,
    EpsilonGreedyPolicy,
)

from benchmarks.dqn import MODALITY, NUM_STARTS, Task
from benchmarks.measure import Options, Side
from benchmarks.time_to_optimal import Learner
from jaxsense import tasks
from jaxsense.core.types import Key
from jaxsense.interfaces.rejax import MapEnv
from jaxsense.run import devices
from jaxsense.tasks.score import Policy


@dataclasses.dataclass(frozen=True)
class Dqn:
    """rejax's DQN as a learner, see `scoreboard.Learner`.

    Attributes:
      updates: gradient steps for each step of all environments.
      replay: transitions; rejax sorts all of them to draw a batch.
      exploration: share of the training until exploration is at its floor.
      target_period: environment steps.
    """

    name = "rejax DQN"
    packages = ("rejax",)
    discount: float = 0.5
    num_envs: int = 128
    updates: int = 4
    batch: int = 256
    replay: int = 8192
    learning_rate: float = 1e-3
    exploration: float = 0.5
    target_period: int = 2560

    def make(self, steps: int, **others: Any) -> Any:
        """The algorithm; `others` are the environment and settings by its own names."""
        return rejax.DQN.create(  # pyright: ignore[reportAttributeAccessIssue]
            num_envs=self.num_envs,
            num_epochs=self.updates,
            batch_size=self.batch,
            buffer_size=self.replay,
            total_timesteps=steps,
            learning_rate=self.learning_rate,
            gamma=self.discount,
            exploration_fraction=self.exploration,
            target_update_freq=self.target_period,
            polyak=0.0,
            **{"fill_buffer": 1024, **others},
        )

    def train(self, task: tasks.Task, seeds: Sequence[int], steps: int) -> dict[int, Policy]:
        """Trains all seeds in one program."""
        algorithm = self.make(steps, **_environment(task))

        def act(params: PyTree, key: Key, observation: jax.Array) -> jax.Array:
            del key
            return jnp.argmax(algorithm.agent.apply(params, observation[None])[0])

        learned = lambda state: state.q_ts.params  # noqa: E731
        return _train(algorithm, seeds, steps // self.num_envs, learned, act)


@dataclasses.dataclass(frozen=True)
class Ppo:
    """rejax's PPO, which draws its actions.

    Attributes:
      num_steps: steps of each environment between two rounds of learning.
      epochs: times that a round learns from each step.
      minibatches: parts of these steps.
      entropy: weight of the policy's entropy.
    """

    name = "rejax PPO"
    packages = ("rejax",)
    discount: float = 0.5
    num_envs: int = 64
    num_steps: int = 16
    epochs: int = 10
    minibatches: int = 4
    learning_rate: float = 1e-3
    entropy: float = 0.01

    def train(self, task: tasks.Task, seeds: Sequence[int], steps: int) -> dict[int, Policy]:
        """Trains all seeds in one program."""
        algorithm = rejax.PPO.create(  # pyright: ignore[reportAttributeAccessIssue]
            **_environment(task),
            num_envs=self.num_envs,
            num_steps=self.num_steps,
            num_epochs=self.epochs,
            num_minibatches=self.minibatches,
            learning_rate=self.learning_rate,
            gamma=self.discount,
            ent_coef=self.entropy,
        )

        def act(params: PyTree, key: Key, observation: jax.Array) -> jax.Array:
            return algorithm.actor.apply(params, observation[None], key, method="act")[0]

        learned = lambda state: state.actor_ts.params  # noqa: E731
        rounds = steps // (self.num_envs * self.num_steps)
        return _train(algorithm, seeds, rounds, learned, act)


LEARNERS = Dqn(), Ppo()
FAST = (
    Dqn(updates=8, batch=256, replay=16384, target_period=5120),
    Dqn(updates=16, batch=256, replay=8192, target_period=5120),
    Dqn(updates=4, batch=256, replay=16384, target_period=5120),
)
"""Good settings for a short training, of which the best counts."""


def throughput(task: Task, options: Options) -> Side:
    """Its speed with the same environments, batch, gradient steps and replay."""
    dqn = task.config.dqn
    number = 2 if options.quick else 100
    settings = Dqn(updates=dqn.updates, batch=dqn.batch, replay=dqn.replay_capacity)
    settings = dataclasses.replace(settings, target_period=25_000)
    algorithm = _of_row(task, settings, steps=100_000)
    state = jax.jit(algorithm.init_state)(jax.random.key(4))
    go_on = jax.jit(lambda state: _iterate(algorithm, state, number))
    return Side(lambda: jax.block_until_ready(go_on(state)), number * dqn.num_envs, dqn.num_envs)


def learner(task: Task, settings: Dqn) -> Learner:
    """Its training, in chunks of as many steps as ours."""
    algorithm, chunk = _of_row(task, settings, steps=40_000), task.config.dqn.chunk
    start = jax.jit(algorithm.init_state)
    return Learner(
        start=lambda: start(jax.random.key(8)),
        go_on=jax.jit(lambda state: _iterate(algorithm, state, chunk), donate_argnums=0),
        # The layers have the same names as ours.
        as_params=lambda state: state.q_ts.params,
    )


def _of_row(task: Task, settings: Dqn, steps: int) -> Any:
    """The algorithm with our network, learning rate, discount and number of environments."""
    dqn, env = task.config.dqn, MapEnv(task.mdp.of(MODALITY))
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


def _environment(task: tasks.Task) -> dict[str, object]:
    """What an algorithm learns in, by rejax's names."""
    env = MapEnv(task)
    return {"env": env, "env_params": env.prepared_params(jax.random.key(2**30), NUM_STARTS)}


def _iterate(algorithm: Any, state: PyTree, number: int) -> PyTree:
    return jax.lax.fori_loop(0, number, lambda _, s: algorithm.train_iteration(s), state)


def _train(
    algorithm: Any,
    seeds: Sequence[int],
    rounds: int,
    learned: Callable[[PyTree], PyTree],
    act: Callable[[PyTree, Key, jax.Array], jax.Array],
) -> dict[int, Policy]:
    """Policies `act(parameters, ...)` after some rounds; `learned(state)` is the parameters."""

    def train(key: Key, algorithm: Any) -> PyTree:
        return learned(_iterate(algorithm, algorithm.init_state(key), max(1, rounds)))

    of_seeds = jax.jit(
        jax.vmap(train, (0, None)), compiler_options=devices.compiler_options(runs_long=True)
    )
    params = jax.device_get(of_seeds(jax.vmap(jax.random.key)(jnp.array(seeds)), algorithm))
    return {
        seed: Partial(act, jax.tree.map(lambda x: x[i], params))  # noqa: B023
        for i, seed in enumerate(seeds)
    }
