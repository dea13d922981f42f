"""The DQN and the PPO of rejax."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.tree_util import Partial
from jaxtyping import PyTree
from rejax import DQN, PPO  # pyright: ignore[reportMissingImports]

from benchmarks.tasks.learner import NUM_STARTS, POINTS, Report, of_seeds, part
from jaxsense.interfaces.rejax import MapEnv
from jaxsense.run import devices
from jaxsense.tasks import Task

_STARTS = jax.random.key(2**30)


@dataclasses.dataclass(frozen=True)
class RejaxDqn:
    """rejax's DQN.

    Attributes:
      discount: of a step.
      num_envs: environments side by side.
      updates: gradient steps for each step of all environments.
      batch: transitions of one of them.
      replay: transitions that are kept; rejax sorts all of them to draw a batch.
      learning_rate: of Adam.
      exploration: share of the training after which exploration has fallen to its floor.
      target_period: environment steps between two copies to the target network.
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
        """The algorithm.

        Args:
          steps: environment steps of a training.
          **others: the environment, its parameters, and other settings, by rejax's names.
        """
        return DQN.create(  # pyright: ignore[reportAttributeAccessIssue]
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

    def train(self, task: Task, seeds: Sequence[int], steps: int, report: Report) -> None:
        """Trains all seeds in one program, see `Learner.train`."""
        algorithm = self.make(steps, **_environment(task))

        def act(params: PyTree, key: jax.Array, observation: jax.Array) -> jax.Array:
            del key
            return jnp.argmax(algorithm.agent.apply(params, observation[None])[0])

        _train(algorithm, seeds, steps, self.num_envs, lambda state: state.q_ts, act, report)


@dataclasses.dataclass(frozen=True)
class RejaxPpo:
    """rejax's PPO, which draws its actions.

    Attributes:
      discount: of a step.
      num_envs: environments side by side.
      num_steps: steps of each between two rounds of learning.
      epochs: times that a round learns from each step.
      minibatches: parts of these steps.
      learning_rate: of Adam.
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

    def train(self, task: Task, seeds: Sequence[int], steps: int, report: Report) -> None:
        """Trains all seeds in one program, see `Learner.train`."""
        algorithm = PPO.create(  # pyright: ignore[reportAttributeAccessIssue]
            **_environment(task),
            num_envs=self.num_envs,
            num_steps=self.num_steps,
            num_epochs=self.epochs,
            num_minibatches=self.minibatches,
            learning_rate=self.learning_rate,
            gamma=self.discount,
            ent_coef=self.entropy,
        )

        def act(params: PyTree, key: jax.Array, observation: jax.Array) -> jax.Array:
            return algorithm.actor.apply(params, observation[None], key, method="act")[0]

        unit = self.num_envs * self.num_steps
        _train(algorithm, seeds, steps, unit, lambda state: state.actor_ts, act, report)


def iterate(algorithm: Any, state: PyTree, number: int) -> PyTree:
    """Some iterations of an algorithm; to be jitted."""
    return jax.lax.fori_loop(0, number, lambda _, s: algorithm.train_iteration(s), state)


def _environment(task: Task) -> dict[str, object]:
    """What an algorithm learns in, by rejax's names."""
    env = MapEnv(task)
    return {"env": env, "env_params": env.prepared_params(_STARTS, NUM_STARTS)}


def _train(
    algorithm: Any,
    seeds: Sequence[int],
    steps: int,
    unit: int,
    learned: Callable[[PyTree], PyTree],
    act: Callable[[PyTree, jax.Array, jax.Array], jax.Array],
    report: Report,
) -> None:
    """Trains an algorithm that takes `unit` steps at a time.

    `learned(state)` holds the parameters with which `act(params, key, observation)` acts.
    """
    number = part(steps, unit)

    keys = jax.vmap(jax.random.key)(jnp.array(seeds))
    states = jax.jit(jax.vmap(algorithm.init_state))(keys)
    of_all = jax.jit(
        jax.vmap(lambda algorithm, state: iterate(algorithm, state, number), (None, 0)),
        donate_argnums=1,
    )
    compiled = of_all.lower(algorithm, states).compile(devices.compiler_options(runs_long=True))
    for i in range(POINTS + 1):
        found = of_seeds(seeds, learned(states).params)
        report(i * number * unit, {seed: Partial(act, params) for seed, params in found.items()})
        if i < POINTS:
            states = jax.block_until_ready(compiled(algorithm, states))


LEARNERS = RejaxDqn(), RejaxPpo()
