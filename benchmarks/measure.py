"""Measures the sides of a row: compile time apart, both sides in turn, medians."""

import dataclasses
import datetime
import functools
import importlib.metadata
import platform
import statistics
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.sharding import NamedSharding, PartitionSpec
from jaxtyping import PyTree

from jaxsense.run import cli, devices, version
from jaxsense.run.devices import Workers
from jaxsense.run.kept import shapes_of, trace

_PACKAGES = ("jax", "jaxlib", "mujoco", "numpy")


@dataclasses.dataclass(frozen=True)
class Options:
    """How to measure a row.

    Attributes:
      peers: measure the peer too.
      quick: tiny sizes, to see that everything runs; the figures mean nothing.
    """

    peers: bool = False
    quick: bool = False

    @property
    def repeats(self) -> int:
        """Measurements of each side."""
        return 1 if self.quick else 7


@dataclasses.dataclass(frozen=True)
class Side:
    """One way of doing the work of a row.

    Attributes:
      run: does the work once, and returns when all of it is done.
      work: units of work in one run, for example physics steps.
      batch: how many were done side by side.
      compile_s: seconds of compiling.
      num_devices: JAX devices in use.
    """

    run: Callable[[], PyTree]
    work: float
    batch: int
    compile_s: float = 0.0
    num_devices: int = 1


@dataclasses.dataclass(frozen=True)
class Row:
    """One line of the table and one object of the JSON.

    Attributes:
      row: its name.
      unit: of `ours` and `theirs`: work per second, or "s", of which less is better.
      ours: median over the repetitions.
      compile_s: seconds of compiling ours; not part of `ours` unless it says so.
      batch: how many of ours were done side by side.
      peer: who is compared with, or None.
      theirs: median over the repetitions; None if the peer was not measured.
      packages: distributions that the peer needs.
      num_devices: JAX devices that ours used.
      is_bound: the peer was stopped: `theirs` and `ratio` are lower bounds.
      also: ours in other units.
    """

    row: str
    unit: str
    ours: float
    compile_s: float
    batch: int
    peer: str | None = None
    theirs: float | None = None
    packages: tuple[str, ...] = ()
    num_devices: int = 1
    is_bound: bool = False
    also: dict[str, float] = dataclasses.field(default_factory=dict)

    @property
    def ratio(self) -> float | None:
        """How many times faster we are."""
        if self.theirs is None:
            return None
        return self.theirs / self.ours if self.unit == "s" else self.ours / self.theirs

    @property
    def origin(self) -> dict[str, Any]:
        """How, where and when the row was measured."""
        peers = "" if self.theirs is None else " --peers"
        packages = () if self.theirs is None else self.packages
        command = f"python -m benchmarks {self.row}{peers}"
        return origin(command, packages, self.num_devices)

    def as_json(self) -> dict[str, object]:
        """The row and its origin."""
        values = dataclasses.asdict(self)
        for internal in ("packages", "num_devices", "is_bound"):
            del values[internal]
        peer = f"{self.peer} (stopped)" if self.is_bound else self.peer
        return {**values, "peer": peer, "ratio": self.ratio, **self.origin}


def origin(command: str, packages: tuple[str, ...] = (), num_devices: int = 1) -> dict[str, Any]:
    """How, where and when results were measured.

    Args:
      command: that measures them.
      packages: distributions used besides those of every row.
      num_devices: JAX devices in use.
    """
    kind = jax.devices()[0].device_kind
    found = {package: importlib.metadata.version(package) for package in (*_PACKAGES, *packages)}
    return {
        "commit": commit(),
        "date": datetime.date.today().isoformat(),
        "cores": devices.cores(),
        "command": command,
        "device": kind if num_devices == 1 else f"{num_devices} x {kind}",
        "versions": {"python": platform.python_version(), **found},
    }


# Read once: the first result that is written changes the source tree.
commit = functools.cache(version.commit)


def batches(
    options: Options, *, quick: int, cpu: tuple[int, ...], accelerator: tuple[int, ...]
) -> tuple[int, ...]:
    """The batches to try: an accelerator needs large ones to be busy."""
    if options.quick:
        return (quick,)
    return cpu if jax.default_backend() == "cpu" else accelerator


def compiled(
    function: Callable[..., PyTree],
    *args: PyTree,
    work: float,
    batch: int,
    workers: Workers = devices.ALONE,
    wide_vectors: bool = False,
) -> Side:
    """Compiles a function for its arguments; the side runs it on them and blocks on the outputs.

    With workers, arguments and outputs are split among them along their first axis, among as many
    threads as divide it; of threads, the side gives the outputs of each.
    """
    if workers.mesh is not None:
        alone = trace(function, devices.share(shapes_of(args), workers.mesh))
        function = devices.spread(alone.__call__, workers.mesh, len(args))
        args = jax.device_put(args, NamedSharding(workers.mesh, PartitionSpec(devices.AXIS)))
    # A single worker also takes what has no rows, such as a key.
    rows = len(jax.tree.leaves(args)[0]) if workers.threads > 1 else 1
    threads = max(n for n in range(1, workers.threads + 1) if rows % n == 0)
    parts = [args]
    if threads > 1:
        split = lambda x, i: x[i * rows // threads : (i + 1) * rows // threads]  # noqa: E731
        parts = [jax.tree.map(lambda x, i=i: split(x, i), args) for i in range(threads)]
    options = devices.compiler_options(runs_long=True, wide_vectors=wide_vectors)
    begin = time.perf_counter()
    program = jax.jit(function).lower(*parts[0]).compile(options)
    compile_s = time.perf_counter() - begin

    def run() -> list[PyTree]:
        work_on = lambda part: jax.block_until_ready(program(*part))  # noqa: E731
        return devices.side_by_side(work_on, parts, threads)

    number = threads if workers.mesh is None else workers.number
    return Side(run, work, batch, compile_s, number)


def compare(
    name: str,
    unit: str,
    ours: Sequence[Side],
    theirs: Sequence[Side],
    options: Options,
    *,
    peer: str | None = None,
    packages: tuple[str, ...] = (),
    repeats: int | None = None,
) -> Row:
    """Measures the fastest of our sides and of theirs, in turn, so that noise hits both.

    Args:
      name: of the row.
      unit: of work per second.
      ours: ways to do it.
      theirs: the peer's ways; none if it is not measured.
      options: how to measure.
      peer: its name.
      packages: distributions that the peer needs.
      repeats: in place of those of the options.
    """
    sides = [_fastest(ours)] + ([_fastest(theirs)] if theirs else [])
    rates: list[list[float]] = [[] for _ in sides]
    for _ in range(repeats or options.repeats):
        for side, measured in zip(sides, rates, strict=True):
            measured.append(side.work / seconds(side.run))
    medians = [statistics.median(measured) for measured in rates]
    return Row(
        name,
        unit,
        medians[0],
        sides[0].compile_s,
        sides[0].batch,
        peer=peer,
        theirs=medians[1] if theirs else None,
        packages=packages,
        num_devices=sides[0].num_devices,
    )


def joined(parts: list[PyTree]) -> PyTree:
    """The results of several threads as one batch, on the host."""
    return jax.tree.map(lambda *x: np.concatenate([np.asarray(each) for each in x]), *parts)


def seconds(run: Callable[[], object]) -> float:
    """Duration of a call."""
    begin = time.perf_counter()
    run()
    return time.perf_counter() - begin


def reserve(program: str, path: Path | None) -> None:
    """Creates the file of `--json`, or ends the program before anything is measured.

    Args:
      program: module that runs.
      path: of the file, which must be new; None if nobody asked for one.
    """
    if path is None:
        return
    commit()
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write("[]\n")
    except FileExistsError:
        cli.fail(program, f"json = {str(path)!r}: already exists; must be new")
    except OSError as error:
        cli.fail(program, f"json = {str(path)!r}: cannot be written: {error.strerror}")


def _fastest(sides: Sequence[Side]) -> Side:
    """The side with most work per second, after a warm-up of each."""
    for side in sides:
        side.run()
    if len(sides) == 1:
        return sides[0]
    return max(sides, key=lambda side: side.work / min(seconds(side.run) for _ in range(2)))
