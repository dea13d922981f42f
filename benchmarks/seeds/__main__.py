"""The program, see `benchmarks.seeds`."""

import dataclasses
import json
import sys
from pathlib import Path
from typing import Annotated, Any

from benchmarks.seeds.runs import gather
from jaxsense.config.checks import check_fields
from jaxsense.config.options import Name
from jaxsense.run import cli

PROGRAM = "benchmarks.seeds"
FILE = Path(__file__).parents[1] / "results" / "seeds.json"


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
    found: dict[str, dict[str, Any]] = {}
    if arguments.out.exists():
        found = json.loads(arguments.out.read_text(encoding="utf-8"))
    for group, of_seeds in gather(arguments.runs, arguments.group).items():
        found[group] = dict(sorted((found.get(group, {}) | of_seeds).items()))
    found = dict(sorted(found.items()))
    arguments.out.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
