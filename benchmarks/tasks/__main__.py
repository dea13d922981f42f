"""`python -m benchmarks.tasks`: trains all learners in the frozen tasks and writes the scoreboard.

Results go to `benchmarks/results`, the tables and the picture made of them to `docs`.
"""

import dataclasses
import json
import shlex
import sys
from pathlib import Path
from typing import Annotated

from benchmarks import results
from benchmarks.tasks import board, jobs, learners, plot, record
from benchmarks.tasks.jobs import Job
from benchmarks.tasks.learner import LearnerError
from jaxsense.config.checks import check_fields, limited, require
from jaxsense.config.options import Name
from jaxsense.run import cli
from jaxsense.show.drawing import svg

PROGRAM = "benchmarks.tasks"
STEPS = {
    ("team-v0", "team"): 32768,
    ("many-v0", "camera"): 65536,
    ("noisy-v0", "camera"): 65536,
    ("map-v0", "camera"): 32768,
}
"""Environment steps of each training, by task and agent; the longest first."""


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Trains in the frozen tasks and writes the scoreboard. Keeps the rows of other learners."""

    learners: Annotated[tuple[str, ...], Name("LEARNERS")] = ()
    """Learners to train; all by default."""
    only: tuple[str, ...] = ()
    """Tasks to train in; all by default."""
    seeds: int = limited(10, at_least=1, at_most=10)
    """Number of seeds for each learner and task, starting from `--first-seed`."""
    first_seed: int = limited(0, at_least=0, at_most=1_000_000)
    """First seed. Use seeds other than the default to choose settings."""
    jobs: int = limited(2, at_least=1, at_most=1024)
    """Number of trainings to run in parallel, each on its own core."""
    out: Path | None = None
    """Folder of results; by default the repository's, with the tables and the picture."""
    page: bool = False
    """Train nothing; only remake the picture and the tables."""
    quick: bool = False
    """Take as few steps as possible, to check that everything runs. Needs `--out`."""

    def __post_init__(self):
        check_fields(self)
        known = [each.name for each in learners.load()]
        are_known = set(self.learners) <= set(known)
        expected = f"must be some of {', '.join(map(repr, known))}, from MODULES in learners.py"
        require(are_known, self, "learners", expected)
        names = sorted({name for name, _ in STEPS})
        require(set(self.only) <= set(names), self, "only", f"must be some of {', '.join(names)}")
        require(not self.quick or self.out is not None, self, "quick", "needs --out FOLDER")
        trains_nothing = self.out is None and not self.learners
        expected = "trains nothing and remakes only the repository's pages"
        require(not self.page or trains_nothing, self, "page", expected)

    @property
    def jobs_to_do(self) -> list[Job]:
        """What is to be trained."""
        seeds = range(self.first_seed, self.first_seed + self.seeds)
        return [
            Job(name, agent, learner, tuple(seeds), 1 if self.quick else steps)
            for (name, agent), steps in STEPS.items()
            for learner in learners.load()
            if name in (self.only or (name,)) and learner.name in (self.learners or (learner.name,))
        ]


def main(argv: list[str] | None = None) -> None:
    """The program."""
    argv = sys.argv[1:] if argv is None else argv
    arguments = cli.parse(PROGRAM, Arguments, argv)
    if not arguments.page:
        command = shlex.join(["python", "-m", PROGRAM, *argv])
        folder = arguments.out or results.RESULTS
        try:
            jobs.run(arguments.jobs_to_do, arguments.jobs, folder, command)
        except LearnerError as error:
            cli.fail(PROGRAM, str(error))
    if arguments.out is not None:
        print(board.tables(json.loads((arguments.out / jobs.SCORES).read_text(encoding="utf-8"))))
    else:
        results.main()
        plot.PICTURE.write_bytes(svg(plot.draw(record.read(results.RESULTS / jobs.CURVES))))


if __name__ == "__main__":
    main()
