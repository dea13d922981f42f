"""`python -m benchmarks.remeasure [NAMES]`: measures results again, and writes the pages anew.

Every file of `benchmarks/results` holds the command that made it. This runs them one after another,
which takes hours for all of them, and replaces each file whose command succeeds. Then it draws the
pictures of these files and writes their tables, see `benchmarks.results`.
"""

import dataclasses
import json
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Annotated, Any

from benchmarks import results
from jaxsense.config.options import Name
from jaxsense.run import cli

PROGRAM = "benchmarks.remeasure"
FIGURES = Path(__file__).parents[1] / "docs" / "figures"
_OTHERWISE: Mapping[str, str] = {
    "seeds": 'train and evaluate as "The commands of the README" in docs/figures.md say, and '
    "gather the runs with python -m benchmarks.seeds",
    "tasks": "python -m benchmarks.tasks writes it",
}
"""Files that no single command with `--json` makes, and what makes them."""
_OF_IMPERFECT = ("imperfect_default", "imperfect_noisy")
_OF_RAW = ("raw_ablation", "raw_ratio", "raw_depth")
_SWEEPS = {
    "imperfect.svg": ("position [m]", "heading [deg]", "both [m]"),
    "imperfect_drift.svg": ("position drift [m]", "heading drift [deg]", "both drifts [m]"),
}


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Measure stored results again, and write the pages anew."""

    names: Annotated[tuple[str, ...], Name("NAMES")] = ()
    """Files of `benchmarks/results` without their ending; by default all that one command makes on
    this kind of device."""


def command_of(content: Any) -> str | None:
    """The command that made the content of a file, if there is a single one.

    Args:
      content: of the JSON file.
    """
    if isinstance(content, dict):
        return content.get("command")
    rows = " ".join(row["row"] for row in content)
    peers = " --peers" if any(row["theirs"] is not None for row in content) else ""
    return f"python -m benchmarks {rows}{peers}"


def device_of(content: Any) -> str:
    """The kind of device that a file was measured on.

    Args:
      content: of the JSON file.
    """
    device = content["device"] if isinstance(content, dict) else content[0]["device"]
    return "cpu" if device.endswith("cpu") else device


def measure(name: str, command: str) -> bool:
    """Runs a command and, if it succeeds, replaces the file; tells whether it did.

    Args:
      name: of the file, without its ending.
      command: that makes it.
    """
    with tempfile.TemporaryDirectory() as folder:
        new = Path(folder) / f"{name}.json"
        words = [sys.executable, *shlex.split(command)[1:], "--json", str(new)]
        if name == "curves":
            words += ["--plot", str(Path(folder) / "noisy_curves.svg")]
        print(f"{name}: {command}", flush=True)
        if subprocess.run(words, check=False).returncode:
            return False
        shutil.move(new, results.RESULTS / new.name)
        for picture in Path(folder).glob("*.svg"):
            shutil.move(picture, FIGURES / picture.name)
    return True


def draw(names: Collection[str]) -> None:
    """Draws the pictures that are made from files.

    Args:
      names: of the files, without their endings.
    """
    plot = [sys.executable, "-m", "benchmarks.imperfect_plot"]
    if "imperfect_messages" in names:
        figures = ["--figures", "accuracy", "own", "nll", "time"]
        _replace([*plot, *_files("imperfect_messages"), *figures], "imperfect_messages.svg")
    if not {*_OF_IMPERFECT}.isdisjoint(names):
        for picture, sweeps in _SWEEPS.items():
            _replace([*plot, *_files(*_OF_IMPERFECT), "--sweeps", *sweeps], picture)
    if not {*_OF_RAW}.isdisjoint(names):
        report = [sys.executable, "-m", "benchmarks.raw.report", *_files(*_OF_RAW)]
        _replace(report, "raw_ablation.svg")
        _replace(report, "raw_posteriors.svg", "--posteriors")


def _files(*names: str) -> list[str]:
    return [str(results.RESULTS / f"{name}.json") for name in names]


def _replace(words: list[str], picture: str, option: str = "--plot") -> None:
    """Draws a picture of the pages anew; the programs write new files only."""
    with tempfile.TemporaryDirectory() as folder:
        new = Path(folder) / picture
        subprocess.run([*words, option, str(new)], check=True)
        shutil.move(new, FIGURES / picture)


def main(argv: list[str] | None = None) -> None:
    """The program."""
    arguments = cli.parse(PROGRAM, Arguments, sys.argv[1:] if argv is None else argv)
    stored = {
        path.stem: json.loads(path.read_text(encoding="utf-8"))
        for path in sorted(results.RESULTS.glob("*.json"))
    }
    for name in arguments.names:
        if name not in stored:
            cli.fail(PROGRAM, f"names = {name!r}: must be one of {', '.join(stored)}")
        if name in _OTHERWISE:
            cli.fail(PROGRAM, f"names = {name!r}: {_OTHERWISE[name]}")
    names = arguments.names or [
        name
        for name, content in stored.items()
        if name not in _OTHERWISE and device_of(content) == "cpu"
    ]
    failed = []
    for name in names:
        command = command_of(stored[name])
        assert command is not None
        if not measure(name, command):
            failed.append(name)
    draw({*names} - {*failed})
    results.main()
    if failed:
        sys.exit(f"not measured: {', '.join(failed)}; their files are as they were")


if __name__ == "__main__":
    main()
