"""What a control step of missions consists of: `python -m benchmarks.kernels --help`.

Counts the kernels that the device runs, and their time, for each part of a control step: the
innermost function of `jaxsense.mission` that has a `jax.named_scope`.
"""

import collections
import dataclasses
import re
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TypeAlias

import jax
import rich.console
import rich.table

from benchmarks import measure
from benchmarks.missions import Playing, of_many_pois, playing, untrained
from jaxsense.config.checks import check_fields, limited
from jaxsense.run import cli, devices

PROGRAM = "benchmarks.kernels"
_SCOPE = re.compile(r"mission\.(\w+)")
_NAMED = re.compile(r'%?([\w.-]+) = .*op_name="([^"]*)"')
_OTHER = "other"

Parts: TypeAlias = dict[str, "Part"]


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Count the kernels of a control step, part by part, and their microseconds."""

    many_pois: bool = False
    """16 PoIs in an arena of 6 m; by default the settings of `default`."""
    batch: int = limited(384, at_least=1)
    """Number of missions side by side."""
    policy: str = "naive"
    """What chooses looks."""
    steps: int = limited(20, at_least=1)
    """Number of control steps to profile, in the middle of missions."""

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
    jax.config.update("jax_default_matmul_precision", "highest")
    config = of_many_pois() if arguments.many_pois else untrained("default")
    missions = playing(config, arguments.policy, arguments.batch, arguments.steps)
    program = missions.compiled(devices.compiler_options())
    wall, parts = profile(program, missions)
    table = rich.table.Table("part", "kernels in a step", "us in a step")
    for name, part in sorted(parts.items(), key=lambda item: -item[1].seconds):
        table.add_row(
            name,
            f"{part.kernels / arguments.steps:,.1f}",
            f"{1e6 * part.seconds / arguments.steps:,.1f}",
        )
    console = rich.console.Console()
    console.print(table)
    number = sum(part.kernels for part in parts.values()) / arguments.steps
    busy = sum(part.seconds for part in parts.values()) / arguments.steps
    console.print(
        f"{arguments.batch} missions of {config.arena.num_pois} PoIs, policy {arguments.policy}, "
        f"{jax.devices()[0].device_kind}: {1e3 * wall / arguments.steps:.3f} ms in a step, "
        f"{number:,.0f} kernels, {1e3 * busy:.3f} ms of them"
    )


def profile(program: jax.stages.Compiled, missions: Playing) -> tuple[float, Parts]:
    """Seconds of a call of a program without the profiler, and its parts with it."""
    run = lambda: jax.block_until_ready(program(*missions.args))  # noqa: E731
    run()
    wall = measure.seconds(run)
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
