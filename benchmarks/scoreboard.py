"""`python -m benchmarks.scoreboard`: trains learners in the frozen tasks and scores them."""

import dataclasses
import functools
import json
import multiprocessing
import os
import shlex
import sys
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing.queues import Queue
from pathlib import Path
from typing import Any, Protocol

import jax
import numpy as np

import jaxsense
from benchmarks import measure, peers
from benchmarks.dqn import Dqn
from jaxsense.config.options import Positional
from jaxsense.config.section import Checked, limited, require
from jaxsense.run import cli
from jaxsense.tasks import Recurrent, Task
from jaxsense.tasks.score import Policy, estimate

PROGRAM = "benchmarks.scoreboard"
STEPS = {
    ("team-v0", "team"): 32768,
    ("many-v0", "camera"): 65536,
    ("noisy-v0", "camera"): 65536,
    ("map-v0", "camera"): 32768,
}
"""Environment steps of each training, by task and agent; the longest first."""


class Learner(Protocol):
    """A frozen dataclass, whose fields are settings, and which pickle can send."""

    @property
    def name(self) -> str:
        """In tables."""
        ...

    @property
    def packages(self) -> tuple[str, ...]:
        """Distributions needed besides jaxsense."""
        ...

    def train(
        self, task: Task, seeds: Sequence[int], steps: int
    ) -> Mapping[int, Policy | Recurrent]:
        """Policies by seed after about `steps` environment steps each, at least one."""
        ...


@functools.cache
def learners() -> tuple[Learner, ...]:
    """All learners whose packages are installed, in the order of the tables."""
    modules = filter(None, map(peers.load, ("sb3", "rejax")))
    return Dqn(), *(each for module in modules for each in module.LEARNERS)


class Arguments(Checked):
    """Trains learners in the frozen tasks and prints the fractions of the best that they reach.

    Attributes:
      learners: Learners to train; all by default.
      only: Tasks to train in; all by default.
      seeds: Number of seeds, from 0 on, of each learner in each task.
      jobs: Number of trainings to run in parallel, each on its own core.
      json: File to write; must be new.
      quick: Take as few steps as possible, to check that everything runs.
    """

    learners: Positional[tuple[str, ...]] = ()
    only: tuple[str, ...] = ()
    seeds: int = limited(10, at_least=1, at_most=10)
    jobs: int = limited(2, at_least=1, at_most=1024)
    json: Path | None = None
    quick: bool = False

    def check(self) -> None:
        """Checks the names of learners and tasks; raises `ConfigError`."""
        for field, known in (
            ("learners", [each.name for each in learners()]),
            ("only", sorted(name for name, _ in STEPS)),
        ):
            expected = f"must be some of {', '.join(known)}"
            require(set(getattr(self, field)) <= set(known), self, field, expected)


@dataclasses.dataclass(frozen=True)
class Job:
    """The trainings of one learner in one task."""

    task: str
    agent: str
    learner: Learner
    seeds: range
    steps: int
    command: str

    def do(self) -> dict[str, Any]:
        """Trains and scores; an object of the JSON."""
        task, learner = jaxsense.make(self.task, self.agent), self.learner
        begin = time.process_time()
        policies = learner.train(task, self.seeds, self.steps)
        seconds = (time.process_time() - begin) / len(self.seeds)
        score = jaxsense.score(task, [policies[seed] for seed in self.seeds])
        return {
            "task": self.task,
            "agent": self.agent,
            "policy": learner.name,
            "returns": score.returns.tolist(),
            "best": score.best,
            "best_returns": score.references[score.best].tolist(),
            "steps": self.steps,
            "seconds": seconds,
            "settings": dataclasses.asdict(learner),  # pyright: ignore[reportArgumentType]
            "about": measure.origin(self.command, learner.packages),
        }


def main(argv: list[str] | None = None) -> None:
    """The program."""
    argv = sys.argv[1:] if argv is None else argv
    arguments = cli.parse(PROGRAM, Arguments, argv)
    measure.reserve(PROGRAM, arguments.json)
    command, seeds = shlex.join(["python", "-m", PROGRAM, *argv]), range(arguments.seeds)
    jobs = [
        Job(task, agent, learner, seeds, 1 if arguments.quick else steps, command)
        for (task, agent), steps in STEPS.items()
        for learner in learners()
        if task in (arguments.only or (task,))
        and learner.name in (arguments.learners or (learner.name,))
    ]
    context = multiprocessing.get_context("spawn")
    cores, rows = context.Queue(), []
    for core in range(arguments.jobs):
        cores.put(core)
    with ProcessPoolExecutor(arguments.jobs, context, _take_core, (cores,)) as executor:
        for row in executor.map(Job.do, jobs):
            rows.append(row)
            print(f"{row['task']}, {row['policy']}: {row['seconds']:.1f} s", file=sys.stderr)
            if arguments.json is not None:
                text = json.dumps(rows, indent=1)
                arguments.json.write_text(f"{text}\n", encoding="utf-8")
    print(tables(rows))


def tables(rows: Sequence[Mapping[str, Any]]) -> str:
    """A Markdown table for each task; seconds are those of one seed, compiling included.

    Args:
      rows: content of the JSON.
    """
    lines: list[str] = []
    for task, agent in dict.fromkeys((row["task"], row["agent"]) for row in rows):
        of_task = [row for row in rows if row["task"] == task]
        titles = "policy", f"fraction of `{of_task[0]['best']}`", "CPU seconds", "environment steps"
        lines += [f"### `{task}`, `{agent}`", "", _line(titles), _line(["---"] * 4)]
        for row in of_task:
            fraction = estimate(np.divide(row["returns"], row["best_returns"]))
            cells = str(fraction), f"{row['seconds']:.3g}", f"{row['steps']:,}"
            lines.append(_line([row["policy"], *cells]))
        lines.append("")
    return "\n".join(lines).rstrip()


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _take_core(cores: "Queue[int]") -> None:
    """Binds a worker process to a core, where the system can."""
    core = cores.get()
    if hasattr(os, "sched_setaffinity"):
        allowed = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, {allowed[core % len(allowed)]})
    # As the programs have it.
    jax.config.update("jax_default_matmul_precision", "highest")


if __name__ == "__main__":
    main()
