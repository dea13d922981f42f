"""The program, see `benchmarks.seeds`."""

import dataclasses
import sys
from pathlib import Path
from typing import Annotated

from benchmarks.seeds.runs import FILE, store
from jaxsense.config.checks import check_fields
from jaxsense.config.options import Name
from jaxsense.run import cli

PROGRAM = "benchmarks.seeds"


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Gathers figures of runs that differ in their seeds.

    They replace those of the same groups and seeds in the file; all others stay.
    """

    runs: Annotated[tuple[Path, ...], Name("RUN")]
    """Directories of finished runs of presets."""
    group: str | None = None
    """Name for runs with other settings than their presets, or for their evaluations alone."""
    out: Path = FILE
    """JSON file to write, or to write into."""

    def __post_init__(self):
        check_fields(self)


def main(argv: list[str] | None = None) -> None:
    """The program."""
    arguments = cli.parse(PROGRAM, Arguments, sys.argv[1:] if argv is None else argv)
    store(arguments.runs, arguments.out, arguments.group)


if __name__ == "__main__":
    main()
