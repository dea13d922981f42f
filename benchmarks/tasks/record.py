"""Learning curves, taken while a learner trains, and their CSV file."""

import csv
import dataclasses
import time
from collections.abc import Iterable, Mapping
from pathlib import Path

import jax
import jax.numpy as jnp

from jaxsense.tasks import Recurrent, Score, Task, mean_return
from jaxsense.tasks.score import Policy

EPISODES = 512
"""Episodes of each point of a curve."""

_KEY = jax.random.key(2**30 + 1)  # neither that of a training nor that of a score


@dataclasses.dataclass(frozen=True)
class Point:
    """A point of a learning curve; a line of the CSV file.

    Attributes:
      task: its name.
      agent: who acts.
      learner: name of the learner.
      seed: of the training.
      steps: environment steps so far.
      seconds: CPU time of the training so far, without compilation and evaluation.
      mean_return: of an episode, without discount.
      fraction: of the mean return of the optimum, or of the best rule, from the same starts.
    """

    task: str
    agent: str
    learner: str
    seed: int
    steps: int
    seconds: float
    mean_return: float
    fraction: float


class Recorder:
    """What a learner reports to, see `learner.Report`.

    Attributes:
      points: of all curves so far.
      policies: the last policy of each seed.
    """

    def __init__(self, task: Task, learner: str, best: float, episodes: int = EPISODES):
        """Records a learner in a task.

        Args:
          task: the task.
          learner: its name.
          best: mean return that counts as 1, see `best_return`.
          episodes: of each point.
        """
        self.points: list[Point] = []
        self.policies: dict[int, Policy | Recurrent] = {}
        self._task, self._learner, self._best, self._episodes = task, learner, best, episodes
        self._seconds = self._since = 0.0

    def __call__(self, steps: int, policies: Mapping[int, Policy | Recurrent]) -> None:
        """Evaluates policies while the clock stands still; 0 steps set it to 0.

        Seeds that train side by side share the time.
        """
        if not isinstance(policies, Mapping) or not policies:
            raise ValueError(
                "report must be called with steps and a dictionary of policies by seed"
            )
        if steps and not set(policies) <= set(self.policies):
            raise ValueError("report must be called with 0 steps first, for each seed")
        passed = (time.process_time() - self._since) / len(policies)
        self._seconds = self._seconds + passed if steps else 0.0
        for seed, policy in policies.items():
            found = mean_return(_KEY, self._task, policy, self._episodes)
            place = self._task.name, self._task.agent, self._learner, seed
            point = Point(*place, steps, self._seconds, found, found / self._best)
            self.points.append(point)
        self.policies |= policies
        self._since = time.process_time()


def best_return(task: Task, episodes: int = EPISODES) -> float:
    """Mean return of the optimum, or of the best rule, from the starts of learning curves.

    Args:
      task: the task.
      episodes: number of episodes.
    """
    known = dict(zip(task.references, jax.device_get(task.returns), strict=True))
    best = Score(task.name, task.agent, task.returns[0], known, task.has_optimum).best  # pyright: ignore

    @jax.jit
    def play(key: jax.Array, task: Task) -> jax.Array:
        keys = jax.random.split(key, episodes)
        return jnp.mean(jax.vmap(lambda key: task.play_reference(key, best))(keys))

    return float(play(_KEY, task))


def write(file: Path, points: Iterable[Point]) -> None:
    """Writes points to a CSV file, one a line, with four decimals."""
    with file.open("w", encoding="utf-8", newline="") as opened:
        writer = csv.writer(opened, lineterminator="\n")
        writer.writerow(field.name for field in dataclasses.fields(Point))
        for point in points:
            values = dataclasses.astuple(point)
            writer.writerow(f"{x:.4f}" if isinstance(x, float) else x for x in values)


def read(file: Path) -> list[Point]:
    """The points that `write` wrote."""
    with file.open(encoding="utf-8", newline="") as opened:
        return [
            Point(
                row["task"],
                row["agent"],
                row["learner"],
                int(row["seed"]),
                int(row["steps"]),
                float(row["seconds"]),
                float(row["mean_return"]),
                float(row["fraction"]),
            )
            for row in csv.DictReader(opened)
        ]
