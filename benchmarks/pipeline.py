"""`python -m benchmarks.pipeline COMMIT`: whole commands, now and in an earlier tree."""

import dataclasses
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

from benchmarks import measure, studies
from jaxsense.config.checks import check_fields, limited
from jaxsense.config.options import Name
from jaxsense.run import cli

PROGRAM = "benchmarks.pipeline"
ROOT = Path(__file__).parents[1]
_MISSIONS = ["--policy", "naive", "--arena.num-pois", "16", "--arena.side", "6"]
_GIB = 2**20  # kB
Figures = Mapping[str, float]
"""What a command needs, by the names of `Needs`."""
KEYS = {
    "seconds": ("seconds", "{:.1f}"),
    "cpu_s": ("CPU seconds", "{:.0f}"),
    "memory_gib": ("peak memory [GiB]", "{:.2f}"),
}
"""What each figure is called in tables, and its format."""


@dataclasses.dataclass(frozen=True)
class Needs:
    """What a command needs.

    Attributes:
      seconds: from its start to its end.
      cpu_s: seconds of all cores.
      memory_gib: at the peak.
    """

    seconds: float
    cpu_s: float
    memory_gib: float


@dataclasses.dataclass(frozen=True)
class Command:
    """A command to measure.

    Attributes:
      name: in tables.
      words: behind `python -m`; `{run}` is the directory of a training by the same tree.
      cold: whether its compilation cache is empty; else it has run once before.
      trains: options of the training, if one is needed first; it is not measured.
    """

    name: str
    words: tuple[str, ...]
    cold: bool = False
    trains: tuple[str, ...] | None = None


TRAIN = ("jaxsense.train", "--seed", "1", "--quiet")
COMMANDS: Mapping[str, Command] = {
    "cold": Command("`train`, cold", TRAIN, cold=True),
    "warm": Command("`train`, warm", TRAIN),
    "team": Command("`train --preset team`, cold", (*TRAIN, "--preset", "team"), cold=True),
    "missions": Command(
        f"`evaluate RUN {' '.join(_MISSIONS)} --episodes 384`, a team of `smoke`, warm",
        ("jaxsense.evaluate", "{run}", *_MISSIONS, "--episodes", "384"),
        # The policies of others play among as many PoIs as they were trained with.
        trains=("--preset", "smoke", "--dqn.task", "team"),
    ),
    "noisy": Command(
        "`evaluate RUN --episodes 1024` of `noisy`, warm",
        ("jaxsense.evaluate", "{run}", "--episodes", "1024"),
        trains=("--preset", "noisy"),
    ),
}
"""What is measured, by the names of the option `commands`."""


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Measures whole commands by this tree and by an earlier one, in turn."""

    commit: Annotated[str, Name("COMMIT")]
    """The earlier tree."""
    commands: tuple[str, ...] = ("cold", "warm", "team", "missions")
    """Which ones. `noisy`, besides, is for accelerators."""
    pairs: int = limited(3, at_least=1)
    """How often each tree is measured; the earlier one first in every other pair. The medians
    count."""
    json: Path | None = None
    """File to write; must be new."""

    def __post_init__(self):
        check_fields(self)


def unpack(commit: str, folder: Path) -> None:
    """Writes the tree of a commit of this repository.

    Args:
      commit: its hash.
      folder: where to.

    Raises:
      subprocess.CalledProcessError: if this checkout does not hold it.
    """
    git = ["git", "-C", str(ROOT), "archive", commit]
    archive = subprocess.run(git, capture_output=True, check=True)
    subprocess.run(["tar", "x", "-C", str(folder)], input=archive.stdout, check=True)


def run(tree: Path, words: Sequence[str], place: Path) -> Needs:
    """Runs a module of a tree of the source, or ends the program if it fails.

    Args:
      tree: the source.
      words: behind `python -m`.
      place: working directory.
    """
    return python(tree, ("-m", *words), place)


def python(
    tree: Path, words: Sequence[str], place: Path, variables: Mapping[str, str] | None = None
) -> Needs:
    """Runs Python with a tree of the source, or ends the program if it fails.

    Args:
      tree: the source.
      words: behind `python`.
      place: working directory.
      variables: of the environment, in place of this program's.
    """
    environment = {**os.environ, **(variables or {}), "PYTHONPATH": str(tree)}
    begin = time.perf_counter()
    process = subprocess.Popen(
        [sys.executable, *words], cwd=place, env=environment, stdout=subprocess.DEVNULL
    )
    _, status, usage = os.wait4(process.pid, 0)
    if status:
        sys.exit(f"python {' '.join(words)}, in {tree}, has failed")
    seconds = time.perf_counter() - begin
    return Needs(seconds, usage.ru_utime + usage.ru_stime, usage.ru_maxrss / _GIB)


def measured(tree: Path, command: Command, place: Path) -> Needs:
    """Runs a command once, after what it needs.

    Args:
      tree: the source.
      command: the command.
      place: an empty directory.
    """
    cache = ("--cache", str(place / "cache"))
    if command.trains is not None:
        run(tree, (*TRAIN, *command.trains, *cache, "--out", str(place / "run")), place)

    def words(number: int) -> tuple[str, ...]:
        given = tuple(str(place / "run") if word == "{run}" else word for word in command.words)
        # An evaluation writes into the directory of its run, under a name that says what it played.
        own = (
            ("--seed", str(number))
            if command.trains is not None
            else ("--out", str(place / f"{number}"))
        )
        return (*given, *cache, *own)

    if not command.cold:
        run(tree, words(1), place)
    return run(tree, words(2), place)


def pairs(
    arguments: Arguments, before: Path, place: Path
) -> Iterator[tuple[str, Mapping[str, object]]]:
    """Yields each command's name, and what both trees need for it.

    The earlier tree runs first in every other pair, so that a machine that slows down or warms up
    favours neither.

    Args:
      arguments: of the program.
      before: the earlier tree.
      place: an empty directory.
    """
    for name in arguments.commands:
        found: dict[str, list[Figures]] = {"before": [], "now": []}
        for i in range(arguments.pairs):
            sides = [("before", before), ("now", ROOT)]
            for side, tree in sides if i % 2 == 0 else reversed(sides):
                own = place / f"{name}-{i}-{side}"
                own.mkdir()
                found[side].append(dataclasses.asdict(measured(tree, COMMANDS[name], own)))
                print(f"{name}, {side}: {found[side][-1]}", file=sys.stderr)
        yield name, {**found, "ratios": ratios(found)}


def ratios(found: Mapping[str, Sequence[Figures]]) -> dict[str, dict[str, Any]]:
    """What this tree needs relative to the earlier one: in each pair, and the median.

    Args:
      found: the pairs' figures, `before` and `now`.
    """
    in_turn = list(zip(found["before"], found["now"], strict=True))
    of_pairs = {key: [now[key] / before[key] for before, now in in_turn] for key in KEYS}
    return {key: {"pairs": x, "median": statistics.median(x)} for key, x in of_pairs.items()}


def table(results: Mapping[str, Any]) -> str:
    """What both trees need, and the ratio of each pair's figures, in Markdown: medians and range.

    Args:
      results: the content of the JSON file.
    """
    before, now = (str(of["commit"])[:10] for of in (results["options"], results))
    heads = ["command"]
    for what, _ in KEYS.values():
        heads += [f"{what}: {before}", now, "ratio"]
    rows = []
    for name, found in results["commands"].items():
        cells = [COMMANDS[name].name]
        for key, (_, form) in KEYS.items():
            cells += [
                form.format(statistics.median(each[key] for each in found[side]))
                for side in ("before", "now")
            ]
            of_pairs = found["ratios"][key]["pairs"]
            span = f" ({min(of_pairs):.2f} to {max(of_pairs):.2f})" if len(of_pairs) > 1 else ""
            cells.append(f"{found['ratios'][key]['median']:.2f}{span}")
        rows.append(cells)
    return studies.with_origin(studies.as_table(heads, rows), results)


def main(argv: list[str] | None = None) -> None:
    """The program."""
    arguments = cli.parse(PROGRAM, Arguments, sys.argv[1:] if argv is None else argv)
    measure.require_known(PROGRAM, "commands", arguments.commands, COMMANDS)
    if arguments.json is not None:
        measure.require_commit(PROGRAM)
    measure.reserve(PROGRAM, "json", arguments.json)
    results = {
        **measure.origin(studies.command(PROGRAM, arguments)),
        "options": {"commit": arguments.commit, "pairs": arguments.pairs},
        "commands": {},
    }
    with tempfile.TemporaryDirectory() as folder:
        before, place = Path(folder) / "before", Path(folder) / "runs"
        before.mkdir()
        place.mkdir()
        try:
            unpack(arguments.commit, before)
        except subprocess.CalledProcessError as error:
            cli.fail(PROGRAM, f"commit = {arguments.commit!r}: {error.stderr.decode().strip()}")
        for name, found in pairs(arguments, before, place):
            results["commands"][name] = found
            studies.write(arguments.json, results)
    print(table(results))


if __name__ == "__main__":
    main()
