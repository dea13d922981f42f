"""What every row is measured with: compile time apart, both sides in turn, medians."""

import dataclasses
import datetime
import importlib.metadata
import platform
import statistics
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.sharding import NamedSharding, PartitionSpec
from jaxtyping import PyTree
from matplotlib.figure import Figure

from jaxsense.run import cli, devices, version
from jaxsense.run.devices import Workers
from jaxsense.run.kept import shapes_of, trace
from jaxsense.show import drawing

_PACKAGES = ("jax", "jaxlib", "mujoco", "numpy")


@dataclasses.dataclass(frozen=True)
class Options:
    """What a row is asked for.

    Attributes:
      peers: measure the peer too.
      quick: tiny sizes, to see that everything runs; the figures mean nothing.
    """

    peers: bool = False
    quick: bool = False

    @property
    def repeats(self) -> int:
        """How often each side is measured."""
        return 1 if self.quick else 7


@dataclasses.dataclass(frozen=True)
class Side:
    """One way of doing the work of a row.

    Attributes:
      run: does the work once, and returns when all of it is done.
      work: units of work in one run, for example physics steps.
      batch: how many were done side by side.
      compile_s: seconds it took to compile.
      num_devices: how many JAX devices it uses.
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
      peer: who is compared with, or None.
      theirs: median over the repetitions; None if the peer was not measured.
      ratio: how many times faster we are.
      compile_s: seconds that ours took to compile, not contained in `ours` unless it says so.
      device: what ours ran on.
      batch: how many of ours were done side by side.
      versions: of Python, packages and the peer.
      is_bound: the peer was stopped before it was done: `theirs` and `ratio` are lower bounds.
      also: ours in other units.
    """

    row: str
    unit: str
    ours: float
    peer: str | None
    theirs: float | None
    ratio: float | None
    compile_s: float
    device: str
    batch: int
    versions: dict[str, str]
    is_bound: bool = False
    also: dict[str, float] = dataclasses.field(default_factory=dict)

    def as_json(self, commit: str | None) -> dict[str, object]:
        """The public keys, and when, where and how it was measured.

        The name of a peer that was stopped says so.

        Args:
          commit: of the code that was measured, read before: there may be another one by now.
        """
        values = dataclasses.asdict(self)
        if values.pop("is_bound"):
            values["peer"] = f"{self.peer} (stopped)"
        peers = " --peers" if self.theirs is not None else ""
        command = f"python -m benchmarks {self.row}{peers}"
        return {**values, **provenance(command), "commit": commit}


def batches(
    options: Options, *, quick: int, cpu: tuple[int, ...], accelerator: tuple[int, ...]
) -> tuple[int, ...]:
    """The batches to try: an accelerator needs large ones to be busy."""
    if options.quick:
        return (quick,)
    return cpu if jax.default_backend() == "cpu" else accelerator


def make_row(
    name: str,
    unit: str,
    ours: float,
    *,
    theirs: float | None = None,
    peer: str | None = None,
    packages: tuple[str, ...] = (),
    compile_s: float,
    batch: int,
    num_devices: int = 1,
    is_bound: bool = False,
) -> Row:
    """A row from its figures; `packages` are the distributions that the peer needs."""
    ratio = None
    if theirs is not None:
        ratio = theirs / ours if unit == "s" else ours / theirs
    kind = jax.devices()[0].device_kind
    return Row(
        row=name,
        unit=unit,
        ours=ours,
        peer=peer,
        theirs=theirs,
        ratio=ratio,
        compile_s=compile_s,
        device=kind if num_devices == 1 else f"{num_devices} x {kind}",
        batch=batch,
        versions=versions(packages if theirs is not None else ()),
        is_bound=is_bound,
    )


def provenance(command: str) -> dict[str, object]:
    """Commit, day, number of cores and the command itself."""
    return {
        "commit": version.commit(),
        "date": datetime.date.today().isoformat(),
        "cores": devices.cores(),
        "command": command,
    }


def versions(packages: tuple[str, ...] = ()) -> dict[str, str]:
    """Versions of Python, of the packages that all rows need, and of `packages`."""
    found = {package: importlib.metadata.version(package) for package in (*_PACKAGES, *packages)}
    return {"python": platform.python_version(), **found}


def origin(command: str, packages: tuple[str, ...] = ()) -> dict[str, object]:
    """How, where and when results were measured, for a JSON file.

    Args:
      command: that measures them.
      packages: distributions that it needs next to those of `versions`.
    """
    return {
        **provenance(command),
        "device": jax.devices()[0].device_kind,
        "versions": versions(packages),
    }


def describe(results: Mapping[str, Any]) -> str:
    """A sentence of what `origin` says, to stand below a table.

    Args:
      results: with the keys of `origin`.
    """
    return f"`{results['command']}`: {where(results)}"


def where(results: Mapping[str, Any]) -> str:
    """The end of that sentence: where and when, without the command.

    Args:
      results: with the keys of `origin`, and perhaps that of `history.note`.
    """
    at = ", ".join(f"{name} {number}" for name, number in results["versions"].items())
    changed = ", whose code has changed since" if results.get("changed") else ""
    return (
        f"{results['device']} with {results['cores']} cores; commit "
        f"{str(results['commit'])[:10]} on {results['date']}{changed}; {at}."
    )


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
        share = devices.part(shapes_of(args), 0, workers.shares)
        alone = trace(function, share)
        function = devices.spread(alone.__call__, workers.mesh)
        args = jax.device_put(args, NamedSharding(workers.mesh, PartitionSpec(devices.AXIS)))
    # A single worker also takes what has no rows, such as a key.
    rows = len(jax.tree.leaves(args)[0]) if workers.threads > 1 else 1
    threads = max(n for n in range(1, workers.threads + 1) if rows % n == 0)
    parts = [devices.part(args, i, threads) for i in range(threads)]
    options = devices.compiler_options(runs_long=True, wide_vectors=wide_vectors)
    begin = time.perf_counter()
    program = jax.jit(function).lower(*parts[0]).compile(options)
    compile_s = time.perf_counter() - begin

    def run() -> list[PyTree]:
        work_on = lambda i: jax.block_until_ready(program(*parts[i]))  # noqa: E731
        return devices.side_by_side(work_on, threads)

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
    """Measures the best of our ways and the best of theirs, in turn, so that noise hits both.

    Args:
      name: of the row.
      unit: of work per second.
      ours: ways to do it; the fastest counts.
      theirs: the peer's ways; none if it is not to be measured.
      options: how often to repeat, unless told by `repeats`.
      peer: who they are.
      packages: distributions that the peer needs.
      repeats: how often each side is measured.

    Returns:
      The row, with medians.
    """
    sides = [_fastest(ours)] + ([_fastest(theirs)] if theirs else [])
    rates: list[list[float]] = [[] for _ in sides]
    for _ in range(repeats or options.repeats):
        for side, measured in zip(sides, rates, strict=True):
            measured.append(side.work / seconds(side.run))
    medians = [statistics.median(measured) for measured in rates]
    return make_row(
        name,
        unit,
        medians[0],
        theirs=medians[1] if theirs else None,
        peer=peer,
        packages=packages,
        compile_s=sides[0].compile_s,
        batch=sides[0].batch,
        num_devices=sides[0].num_devices,
    )


def joined(parts: list[PyTree]) -> PyTree:
    """The results of several threads as one batch, on the host."""
    return jax.tree.map(lambda *x: np.concatenate([np.asarray(each) for each in x]), *parts)


def seconds(run: Callable[[], object]) -> float:
    """How long a call takes."""
    begin = time.perf_counter()
    run()
    return time.perf_counter() - begin


def require_known(program: str, option: str, names: Iterable[str], known: Iterable[str]) -> None:
    """Ends the program if a name is unknown, before anything is measured.

    Args:
      program: module that runs.
      option: that holds the names.
      names: what to check.
      known: all that there are.
    """
    known = list(known)
    for name in names:
        if name not in known:
            cli.fail(program, f"{option} = {name!r}: must be one of {', '.join(known)}")


def require_commit(program: str) -> None:
    """Ends the program, before anything is measured, if no commit holds the code that runs.

    Args:
      program: module that runs.
    """
    found = version.commit()
    if found is None or found.endswith("-dirty"):
        cli.fail(program, f"commit = {found!r}: must be one without changes")


def reserve(program: str, option: str, path: Path | None) -> None:
    """Makes an empty list of results, or ends the program, before anything is measured.

    Args:
      program: module that runs.
      option: that names the file.
      path: of the file, which must be new; None if nobody asked for one.
    """
    if path is None:
        return
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write("[]\n")
    except FileExistsError:
        cli.fail(program, f"{option} = {str(path)!r}: already exists; must be new")
    except OSError as error:
        cli.fail(program, f"{option} = {str(path)!r}: cannot be written: {error.strerror}")


def save(program: str, option: str, path: Path, figure: Figure) -> None:
    """Writes a picture to a new file, or ends the program.

    Args:
      program: module that runs.
      option: that names the file.
      path: of the file: an SVG if its name ends in `.svg`, else a PNG.
      figure: the picture.
    """
    content = drawing.encoded(figure, path)
    try:
        with path.open("xb") as file:
            file.write(content)
    except OSError as error:
        cli.fail(program, f"{option} = {str(path)!r}: cannot be written: {error.strerror}")


def _fastest(sides: Sequence[Side]) -> Side:
    """The one that does most work per second, after a warm-up of each."""
    for side in sides:
        side.run()
    if len(sides) == 1:
        return sides[0]
    return max(sides, key=lambda side: side.work / min(seconds(side.run) for _ in range(2)))
