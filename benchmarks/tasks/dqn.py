"""Our own DQN."""

import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jaxtyping import PyTree

from benchmarks.tasks.learner import NUM_STARTS, POINTS, Report, of_seeds, part
from jaxsense.config import DqnConfig
from jaxsense.core.types import Key
from jaxsense.dqn import training
from jaxsense.dqn.training import DqnState
from jaxsense.run import devices
from jaxsense.tasks import Task, greedy


@dataclasses.dataclass(frozen=True)
class Dqn:
    """`jaxsense.dqn.train`, with the network of the task's preset.

    Attributes:
      discount: of a step.
      discount_of_a_second: in place of that of a step, in a team.
      num_envs: environments side by side.
      updates: gradient steps for each step of all environments.
      batch: transitions of one of them.
      replay: transitions that are kept.
      learning_rate: the first; it falls along a cosine.
      exploration: share of the training after which a hundredth of the first exploration is left.
      target_period: steps of all environments between two copies to the target network.
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

    def train(self, task: Task, seeds: Sequence[int], steps: int, report: Report) -> None:
        """Trains all seeds in one program, see `Learner.train`."""
        agent = task.models.agent.with_discount(
            step=self.discount, second=self.discount_of_a_second
        )
        chunk = part(steps, self.num_envs)
        epochs = POINTS * chunk
        settings = DqnConfig(
            num_envs=self.num_envs,
            epochs=epochs,
            chunk=chunk,
            updates=self.updates,
            batch=self.batch,
            replay_capacity=self.replay,
            learning_rate=self.learning_rate,
            epsilon_decay=0.01 ** (1 / (self.exploration * epochs)),
            target_period=self.target_period,
            num_starts=NUM_STARTS,
        )

        def begin(key: jax.Array, task: Task) -> tuple[Key, PyTree, DqnState[PyTree]]:
            init_key, start_key, chunk_key = jax.random.split(key, 3)
            learning = task.learning(agent)
            prepared = training.starts(start_key, learning, settings)
            state = training.init(init_key, learning, settings, prepared)
            return jax.random.split(chunk_key, POINTS), prepared, state

        def advance(
            key: jax.Array, task: Task, prepared: PyTree, state: DqnState[PyTree]
        ) -> DqnState[PyTree]:
            learning = task.learning(agent)
            return training.train_chunk(key, learning, settings, state, prepared)[0]

        keys = jax.vmap(jax.random.key)(jnp.array(seeds))
        keys, prepared, states = jax.jit(jax.vmap(begin, (0, None)))(keys, task)
        of_all = jax.jit(jax.vmap(advance, (0, None, 0, 0)), donate_argnums=3)
        lowered = of_all.lower(keys[:, 0], task, prepared, states)
        compiled = lowered.compile(devices.compiler_options(runs_long=True))
        for i in range(POINTS + 1):
            learned = of_seeds(seeds, states.params)
            policies = {seed: greedy(task, agent, params) for seed, params in learned.items()}
            report(i * chunk * self.num_envs, policies)
            if i < POINTS:
                states = compiled(keys[:, i], task, prepared, states)
                jax.block_until_ready(states)


LEARNERS = (Dqn(),)
