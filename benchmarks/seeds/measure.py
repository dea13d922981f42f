"""`python -m benchmarks.seeds.measure [GROUPS]`: trains, evaluates and gathers the runs of a plan.

A second call continues where the first one stopped: finished trainings and evaluations stay as they
are, and a stopped training is resumed. Delete a run directory to train it again.
"""

import dataclasses
import shlex
import sys
from pathlib import Path
from typing import Annotated

from benchmarks import commands
from benchmarks.seeds.plan import GROUPS, Group
from benchmarks.seeds.runs import FILE, store
from jaxsense.config.checks import check_fields, require
from jaxsense.config.options import Name
from jaxsense.run import cli

PROGRAM = "benchmarks.seeds.measure"
_DONE = "evaluated.txt"  # in a run directory: options of its evaluations so far


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Trains, evaluates and gathers the runs behind the tables over seeds."""

    groups: Annotated[tuple[str, ...], Name("GROUPS")] = ()
    """Groups of `benchmarks.seeds.plan`; all by default."""
    folder: Path = Path("runs/seeds")
    """Directory of the run directories."""
    out: Path = FILE
    """JSON file to write into."""

    def __post_init__(self):
        check_fields(self)
        is_known = set(self.groups) <= set(GROUPS)
        require(is_known, self, "groups", f"must be some of {', '.join(GROUPS)}")


def finish(group: Group, seed: int, folder: Path) -> bool:
    """Does what a run still lacks, and tells whether it is then complete.

    Args:
      group: of the run.
      seed: of its training.
      folder: of the run directories.
    """
    run = group.run(folder, seed)
    if not (run / "summary.json").exists():
        command, option = group.train(seed), "--out"
        if (run / "config.json").exists():
            command, option = "python -m jaxsense.train", "--resume"
        if not commands.run(command, option, str(run)):
            return False
    note = run / _DONE
    done = note.read_text(encoding="utf-8").splitlines() if note.exists() else []
    for words in group.evaluations:
        if words not in done:
            if not commands.run(group.evaluate(shlex.quote(str(run)), words)):
                return False
            done.append(words)
            note.write_text("\n".join(done) + "\n", encoding="utf-8")
    return True


def main(argv: list[str] | None = None) -> None:
    """The program."""
    arguments = cli.parse(PROGRAM, Arguments, sys.argv[1:] if argv is None else argv)
    groups = [GROUPS[name] for name in arguments.groups or GROUPS]
    complete: dict[str, list[Path]] = {group.name: [] for group in groups}
    failed = []
    for group in groups:
        for seed in group.seeds:
            run = group.run(arguments.folder, seed)
            is_complete = finish(group, seed, arguments.folder)
            (complete[group.name] if is_complete else failed).append(run)
    # Last, because a changed file changes the commit that runs note.
    for name, runs in complete.items():
        if runs:
            store(runs, arguments.out, name)
    if failed:
        sys.exit(f"not measured: {', '.join(map(str, failed))}")


if __name__ == "__main__":
    main()
