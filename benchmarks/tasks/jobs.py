"""Trainings side by side, and their results.

They are no part of `__main__`, which worker processes cannot import.
"""

import dataclasses
import multiprocessing
import os
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing.queues import Queue
from pathlib import Path

import jax
import rich.console

import jaxsense
from benchmarks import measure
from benchmarks.tasks import board, learners, record
from benchmarks.tasks.board import Row
from benchmarks.tasks.learner import Learner, LearnerError
from benchmarks.tasks.record import Point, Recorder
from jaxsense import tasks

SCORES, CURVES = "tasks.json", "tasks_curves.csv"
"""Names of the results."""


@dataclasses.dataclass(frozen=True)
class Job:
    """The trainings of one learner in one task.

    Attributes:
      task: its name.
      agent: who acts.
      learner: who learns.
      seeds: of the trainings.
      steps: environment steps of each.
    """

    task: str
    agent: str
    learner: Learner
    seeds: tuple[int, ...]
    steps: int


def do(job: Job, provenance: dict[str, object]) -> tuple[Row, list[Point]]:
    """Trains, and gives the row and the curves.

    Args:
      job: what to train.
      provenance: from `measure.provenance`.
    """
    begin = time.perf_counter()
    task, learner = tasks.make(job.task, job.agent), job.learner
    recorder = Recorder(task, learner.name, record.best_return(task))
    try:
        learner.train(task, job.seeds, job.steps, recorder)
        settings, versions = dataclasses.asdict(learner), measure.versions(learner.packages)  # pyright: ignore[reportArgumentType]
    except Exception as error:
        raise LearnerError(f"{learner.name}: {type(error).__name__}: {error}") from error
    trained = {point.seed for point in recorder.points if point.steps}
    if missing := set(job.seeds) ^ trained:
        raise LearnerError(
            f"{learner.name} has not reported policies of the seeds {sorted(missing)}"
        )
    found = jaxsense.score(task, [recorder.policies[seed] for seed in job.seeds])
    last = [[p for p in recorder.points if p.seed == seed][-1] for seed in job.seeds]
    row = board.row(
        found,
        learner.name,
        steps=max(point.steps for point in last),
        seconds=sum(point.seconds for point in last) / len(last),
        wall_seconds=time.perf_counter() - begin,
        settings=settings,
        about={
            **provenance,
            "device": jax.devices()[0].device_kind,
            "versions": versions,
        },
    )
    return row, recorder.points


def run(jobs: Sequence[Job], number: int, folder: Path, command: str) -> None:
    """Does some jobs side by side, and writes the results after each.

    Args:
      jobs: what to train.
      number: how many side by side.
      folder: of the results; those of other jobs stay.
      command: that was asked for.
    """
    console = rich.console.Console(stderr=True)
    folder.mkdir(parents=True, exist_ok=True)
    scores, curves = folder / SCORES, folder / CURVES
    rows = {row.place: row for row in board.read(scores)}
    points = record.read(curves) if curves.exists() else []
    # Before any result is written, which would be a change of the source tree.
    provenance = measure.provenance(command)
    context = multiprocessing.get_context("spawn")
    cores = context.Queue()
    for core in range(number):
        cores.put(core)
    begin = time.perf_counter()
    with ProcessPoolExecutor(number, context, _take_core, (cores,)) as executor:
        for future in as_completed([executor.submit(do, job, provenance) for job in jobs]):
            row, found = future.result()
            rows[row.place] = row
            others = [p for p in points if (p.task, p.agent, p.learner) != row.place]
            points = [*others, *found]
            board.write(scores, sorted(rows.values(), key=lambda row: _order(*row.place)))
            points.sort(key=lambda p: (*_order(p.task, p.agent, p.learner), p.seed, p.steps))
            record.write(curves, points)
            passed = time.perf_counter() - begin
            console.print(
                f"{passed:6.0f} s: {', '.join(row.place)}: "
                f"{tasks.estimate(row.fractions)} of {row.best}, {row.seconds:.1f} s each, "
                f"{row.wall_seconds:.0f} s in all"
            )


def _order(task: str, agent: str, learner: str) -> tuple[str, str, int]:
    """The place of a row in the tables."""
    names = [each.name for each in learners.load()]
    return task, agent, names.index(learner) if learner in names else len(names)


def _take_core(cores: "Queue[int]") -> None:
    """Binds a worker process to a core of its own, where the system can."""
    core = cores.get()
    if hasattr(os, "sched_setaffinity"):
        allowed = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, {allowed[core % len(allowed)]})
    # As the programs have it.
    jax.config.update("jax_default_matmul_precision", "highest")
