"""What a control step of missions consists of: `python -m benchmarks.kernels --help`.

Counts the kernels that the device runs, and their time, for each part of a control step: the
innermost function of `jaxsense.mission` that has a `jax.named_scope`.
"""

import collections
import dataclasses
import os
import re
import shlex
import statistics
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import jax

from benchmarks import measure, studies
from benchmarks.missions import Playing, of_many_pois, playing, untrained
from jaxsense.config import Config
from jaxsense.config.checks import check_fields, limited
from jaxsense.run import cli, devices

PROGRAM = "benchmarks.kernels"
_SCOPE = re.compile(r"mission\.(\w+)")
_NAMED = re.compile(r'%?([\w.-]+) = .*op_name="([^"]*)"')
_OTHER = "other"

Parts: TypeAlias = dict[str, "Part"]


CASES: Mapping[str, tuple[Callable[[], Config], int]] = {
    "few": (partial(untrained, "default"), 384),
    "many": (partial(untrained, "default"), 16384),
    "pois": (of_many_pois, 8192),
    "robots": (partial(of_many_pois, robots=("camera", "lidar") * 3), 2048),
}
"""Settings and number of missions, by the names of the option `cases`."""


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Counts the kernels of a control step, part by part, and their milliseconds."""

    cases: tuple[str, ...] = tuple(CASES)
    """Which missions: `few` (384) and `many` (16,384) with the settings of `default`, 8,192 with 16
    PoIs (`pois`), or 2,048 with six robots among 16 PoIs (`robots`)."""
    policy: str = "naive"
    """What chooses looks."""
    steps: int = limited(20, at_least=1)
    """Number of control steps to profile, in the middle of missions."""
    json: Path | None = None
    """File to write; must be new."""

    def __post_init__(self):
        check_fields(self)


@dataclasses.dataclass(frozen=True)
class Part:
    """The kernels of one part.

    Attributes:
      kernels: number of runs of a kernel.
      seconds: that they took.
    """

    kernels: int
    seconds: float


def main(argv: list[str] | None = None) -> None:
    """The program."""
    arguments = cli.parse(PROGRAM, Arguments, sys.argv[1:] if argv is None else argv)
    measure.require_known(PROGRAM, "cases", arguments.cases, CASES)
    if arguments.json is not None:
        measure.require_commit(PROGRAM)
    measure.reserve(PROGRAM, "json", arguments.json)
    jax.config.update("jax_default_matmul_precision", "highest")
    results: dict[str, Any] = {
        **measure.origin(_command(arguments)),
        "steps": arguments.steps,
        "cases": {},
    }
    for name in arguments.cases:
        settings, batch = CASES[name]
        missions = playing(settings(), arguments.policy, batch, arguments.steps)
        # As the rows of missions under way.
        options = devices.compiler_options(runs_long=True, wide_vectors=True)
        wall, parts = profile(missions.compiled(options), missions)
        results["cases"][name] = {
            "wall_s": wall,
            "parts": {part: dataclasses.asdict(of) for part, of in parts.items()},
        }
        studies.write(arguments.json, results)
    print(table(results))


def _command(arguments: Arguments) -> str:
    """The command that counts the same again, with the options of XLA, which it depends on."""
    flags = os.environ.get("XLA_FLAGS")
    command = studies.command(PROGRAM, arguments)
    return command if flags is None else f"XLA_FLAGS={shlex.quote(flags)} {command}"


def table(results: Mapping[str, Any]) -> str:
    """Kernels and milliseconds of a control step, part by part, in Markdown.

    Args:
      results: the content of the JSON file.
    """
    steps, cases = results["steps"], results["cases"]
    heads = ["kernels in a step; ms"]
    for name in cases:
        settings, batch = CASES[name]
        config = settings()
        robots, num_pois = len(config.carried), config.arena.num_pois
        heads.append(f"{batch:,} missions, {robots} robots, {num_pois} PoIs")

    def cell(number: int, seconds: float) -> str:
        return f"{number / steps:,.0f}; {1e3 * seconds / steps:.2f}"

    def of_all(case: Mapping[str, Any], key: str) -> Any:
        return sum(part[key] for part in case["parts"].values())

    rows = [["all", *(cell(of_all(x, "kernels"), of_all(x, "seconds")) for x in cases.values())]]
    walls = [f"{1e3 * case['wall_s'] / steps:.2f}" for case in cases.values()]
    rows.append(["wall clock, without the profiler", *walls])
    longest = collections.Counter[str]()
    for case in cases.values():
        longest.update({name: part["seconds"] for name, part in case["parts"].items()})
    for name, _ in longest.most_common():
        parts = [case["parts"].get(name, {"kernels": 0, "seconds": 0.0}) for case in cases.values()]
        rows.append([f"`{name}`", *(cell(part["kernels"], part["seconds"]) for part in parts)])
    return studies.with_origin(studies.as_table(heads, rows), results)


def profile(program: jax.stages.Compiled, missions: Playing) -> tuple[float, Parts]:
    """Median seconds of a call of a program without the profiler, and its parts with it."""
    run = lambda: jax.block_until_ready(program(*missions.args))  # noqa: E731
    run()
    wall = statistics.median(measure.seconds(run) for _ in range(measure.Options().repeats))
    with tempfile.TemporaryDirectory() as place:
        with jax.profiler.trace(place):
            run()
        (path,) = Path(place).rglob("*.xplane.pb")
        data = jax.profiler.ProfileData.from_file(str(path))
    return wall, _parts(data, program.as_text() or "")


def _parts(data: Any, text: str) -> Parts:
    """The kernels of a profile by the part that the program's text says they belong to."""
    part_of = {name: (_SCOPE.findall(path) or [_OTHER])[-1] for name, path in _NAMED.findall(text)}
    kernels = collections.Counter[str]()
    seconds = collections.defaultdict[str, float](float)
    for name, duration in _kernels(data):
        part = part_of.get(name, _OTHER)
        kernels[part] += 1
        seconds[part] += duration
    return {part: Part(kernels[part], seconds[part]) for part in kernels}


def _kernels(data: Any) -> Iterator[tuple[str, float]]:
    """Operation and seconds of every kernel that ran."""
    planes = list(data.planes)
    of_device = [plane for plane in planes if plane.name.startswith("/device:")]
    for plane in of_device or planes:
        for line in plane.lines:
            for event in line.events:
                operation = dict(event.stats).get("hlo_op")
                if operation is not None:
                    yield str(operation), event.duration_ns / 1e9


if __name__ == "__main__":
    main()
