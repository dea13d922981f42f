"""`python -m benchmarks.remeasure [NAMES]`: measures results again, and writes the pages anew.

Every file of `benchmarks/results` holds the command that made it. This runs them one after another,
which takes hours for all of them, and replaces each file whose command succeeds. Then it draws the
pictures of these files, see `benchmarks.pictures`, and writes their tables, see
`benchmarks.results`. A line says of each file that is left out where or how to measure it.
"""

import collections
import dataclasses
import json
import platform
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any

from benchmarks import commands, measure, pictures, results
from jaxsense.config.options import Name
from jaxsense.run import cli

PROGRAM = "benchmarks.remeasure"


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Measures stored results again, and writes the pages anew."""

    names: Annotated[tuple[str, ...], Name("NAMES")] = ()
    """Files of `benchmarks/results` without their ending; by default all that this kind of device
    has made, and all pictures that need no training."""


@dataclasses.dataclass(frozen=True)
class Measurement:
    """What makes a file of results, or a part of it.

    Attributes:
      name: of the file, without its ending.
      command: that makes it.
      device: kind that it was measured on, with a number if there were several accelerators.
      python: version that measured it.
      writes: whether the command writes the file; otherwise it has an option `--json`.
    """

    name: str
    command: str
    device: str
    python: str
    writes: bool = False

    def measure(self) -> bool:
        """Runs the command and, if it succeeds, replaces the file; tells whether it did."""
        if self.writes:
            return commands.run(self.command)
        with tempfile.TemporaryDirectory() as folder:
            new = Path(folder) / f"{self.name}.json"
            is_made = commands.run(self.command, "--json", str(new))
            if is_made:
                shutil.move(new, results.RESULTS / new.name)
        return is_made


def _of_study(name: str, content: Any) -> Iterator[Measurement]:
    """One run of a program, which notes its own origin."""
    yield _of(name, content["command"], content["device"], content["versions"])


def _of_faults(name: str, calls: Any) -> Iterator[Measurement]:
    """All faults in one command; later ones have tried some again."""
    yield from _of_study(name, calls[0])


def _of_rows(name: str, rows: Any) -> Iterator[Measurement]:
    """Rows of the benchmark of speed, in one command."""
    yield _of(name, results.command(rows), rows[0]["device"], rows[0]["versions"])


def _of_tasks(name: str, rows: Any) -> Iterator[Measurement]:
    """The scoreboard."""
    about = rows[0]["about"]
    found = _of(name, "python -m benchmarks.tasks", about["device"], about["versions"])
    yield dataclasses.replace(found, writes=True)


def _of_seeds(name: str, groups: Any) -> Iterator[Measurement]:
    """Runs with different seeds, of whose groups each may have other devices."""
    of_device = collections.defaultdict(list)
    for group, runs in groups.items():
        run = next(iter(runs.values()))
        of_device[", ".join(run["devices"])].append((group, run["versions"]))
    for device, found in of_device.items():
        names = " ".join(group for group, _ in found)
        each = _of(name, f"python -m benchmarks.seeds.measure {names}", device, found[0][1])
        yield dataclasses.replace(each, writes=True)


def _of(name: str, command: str, device: str, versions: Mapping[str, str]) -> Measurement:
    kind = "cpu" if device.endswith("cpu") else device
    return Measurement(name, command, kind, versions["python"])


_MADE: Mapping[str, Callable[[str, Any], Iterator[Measurement]]] = {
    "faults": _of_faults,
    "tasks": _of_tasks,
    "seeds": _of_seeds,
    **{Path(name).stem: _of_rows for name in results.ROWS},
}
"""What reads from the content of a file how it was made; a study by default."""


def device_here() -> str:
    """The kind of the present device, with a number if there are several accelerators."""
    # In a process of its own: this one must not take an accelerator's memory.
    script = "import jax; print(*(each.device_kind for each in jax.devices()), sep='\\n')"
    words = [sys.executable, "-c", script]
    kinds = subprocess.run(words, check=True, capture_output=True, text=True).stdout.splitlines()
    return kinds[0] if len(kinds) == 1 or kinds[0] == "cpu" else f"{len(kinds)} x {kinds[0]}"


def here(measurements: list[Measurement]) -> list[Measurement]:
    """The measurements that can be repeated here; prints a line about each other one.

    Args:
      measurements: all of them.
    """
    device, python = device_here(), _minor(platform.python_version())
    # Files that one command made with several versions of Python differ in nothing else.
    number = collections.Counter((x.command, x.device) for x in measurements)
    found = []
    for each in measurements:
        runs = [word for word in shlex.split(each.command) if word.startswith("runs/")]
        lacks = [run for run in runs if not Path(run).exists()]
        if each.device != device:
            reason = f"measured on {each.device}: run `{each.command}` there"
        elif number[each.command, each.device] > 1 and _minor(each.python) != python:
            reason = f"measured with Python {_minor(each.python)}: run `{each.command}` with it"
        elif lacks:
            reason = f"needs {', '.join(lacks)}: train it with the command of the page"
        else:
            found.append(each)
            continue
        print(f"left out: {each.name}: {reason}", flush=True)
    return found


def _minor(version: str) -> str:
    return ".".join(version.split(".")[:2])


def main(argv: list[str] | None = None) -> None:
    """The program."""
    arguments = cli.parse(PROGRAM, Arguments, sys.argv[1:] if argv is None else argv)
    stored = {
        path.stem: list(
            _MADE.get(path.stem, _of_study)(path.stem, json.loads(path.read_text("utf-8")))
        )
        for path in sorted(results.RESULTS.glob("*.json"))
    }
    measure.require_known(PROGRAM, "names", arguments.names, stored)
    chosen = [each for name in arguments.names or stored for each in stored[name]]
    if not arguments.names:
        chosen = here(chosen)
    failed = {each.name: None for each in chosen if not each.measure()}
    measured = {each.name for each in chosen} - {*failed}
    drawings = pictures.DRAWINGS if arguments.names else pictures.untrained()
    if arguments.names:
        drawings = [x for x in drawings if not measured.isdisjoint(x.results)]
    undrawn = pictures.draw(drawings)
    results.main()
    if failed or undrawn:
        sys.exit(f"not measured: {', '.join([*failed, *undrawn])}; their files are as they were")


if __name__ == "__main__":
    main()
