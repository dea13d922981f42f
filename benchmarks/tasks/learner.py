"""What a row of the scoreboard is asked for."""

from collections.abc import Callable, Mapping, Sequence
from typing import Protocol, TypeVar

import jax

from jaxsense.tasks import Recurrent, Task
from jaxsense.tasks.score import Policy

T = TypeVar("T")

POINTS = 10
"""Points of a learning curve after the first."""
NUM_STARTS = 8192
"""Prepared starts of episodes: a new one in each step would cost more than the step."""

Report = Callable[[int, Mapping[int, Policy | Recurrent]], None]
"""`(environment steps of each training so far, policy of each seed) -> None`; stops the clock."""


class Learner(Protocol):
    """A way to learn a policy; a frozen dataclass, whose fields are its settings.

    Attributes:
      name: in tables.
      packages: distributions that it needs besides jaxsense.
    """

    @property
    def name(self) -> str:
        """In tables."""
        ...

    @property
    def packages(self) -> tuple[str, ...]:
        """Distributions that it needs."""
        ...

    def train(self, task: Task, seeds: Sequence[int], steps: int, report: Report) -> None:
        """Trains once with each seed, one after another or side by side.

        Args:
          task: what to learn in.
          seeds: of the trainings.
          steps: environment steps of each training.
          report: told the policies as they are: with 0 steps when all is compiled and a training
            begins, then about `POINTS` times, the last time at its end.
        """
        ...


class LearnerError(RuntimeError):
    """A learner did not do what it is asked for; names the learner."""


def part(steps: int, unit: int) -> int:
    """How many units of steps there are between two points of a learning curve, at least one.

    Args:
      steps: environment steps of a training.
      unit: environment steps that a learner takes at a time.
    """
    return max(1, round(steps / POINTS / unit))


def of_seeds(seeds: Sequence[int], params: T) -> dict[int, T]:
    """Parameters of each seed, from arrays `[seeds, ...]`.

    Args:
      seeds: of the trainings.
      params: a pytree.
    """
    found = jax.device_get(params)
    return {seed: jax.tree.map(lambda x: x[i], found) for i, seed in enumerate(seeds)}  # noqa: B023
