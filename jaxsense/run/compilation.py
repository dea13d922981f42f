"""Compiles programs in the background, and keeps them in a directory for later runs.

JAX's cache finds compiled programs by their traces. Tracing takes as long as everything else, so
another directory holds the traces, found by all that tracing depends on.
"""

import contextlib
import functools
import hashlib
import os
import pickle
import stat
import warnings
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Literal, NamedTuple, TypeAlias

import jax
import numpy as np
from jax import export
from jax.sharding import Mesh
from jaxtyping import PyTree

from jaxsense.config import ConfigError
from jaxsense.run import devices, files, version
from jaxsense.run.devices import Workers
from jaxsense.run.monitor import Monitor
from jaxsense.run.output import complain

Function: TypeAlias = Callable[..., PyTree]

_MAX_KEPT = 512  # traced programs; a run has about twenty
_MAX_BYTES = 2**31  # of compiled programs
_SUFFIX = f"-{32 * '[0-9a-f]'}.stablehlo"
_ROWS_AT_ONCE = 512  # of each thread; their results take up little memory besides those of all


class Traced(NamedTuple):
    """A traced program that takes and returns flat leaves, and the structure of its results.

    `jax.export` could write structures itself, but only of classes that are registered with it,
    once per process and name.
    """

    flat: export.Exported
    structure: object

    def __call__(self, *args: PyTree) -> PyTree:
        """Calls the program with arguments of the structure with which it was traced."""
        return jax.tree.unflatten(self.structure, self.flat.call(*jax.tree.leaves(args)))


def trace(function: Function, args: PyTree) -> Traced:
    """Traces a program and lowers it, apart from whatever calls it.

    Raises:
      NotImplementedError: if it calls something that JAX cannot export, such as the host.
    """
    leaves, structure = jax.tree.flatten(args)
    results: list[object] = []

    def flat(*leaves: jax.Array) -> list[jax.Array]:
        output = function(*jax.tree.unflatten(structure, leaves))
        results.append(jax.tree.structure(output))
        return jax.tree.leaves(output)

    exported = export.export(jax.jit(flat))(*shapes_of(leaves))
    return Traced(exported, results[-1])


def shapes_of(args: PyTree) -> PyTree[jax.ShapeDtypeStruct]:
    """Shapes and dtypes of arguments; Python numbers count as JAX arrays."""
    return jax.eval_shape(lambda args: args, args)


class Kept:
    """Cache of traced programs in the directory `path`."""

    def __init__(self, directory: Path, *settings: object):
        """Opens the cache, and removes the least recently used programs.

        Args:
          directory: holds the cache, in `traced`.
          *settings: what programs close over outside jaxsense's source; their `repr` differs.

        Raises:
          OSError: if the directory cannot be made, or if other users may write to it: loading a
            program runs it.
        """
        self.path, self._complain = directory / "traced", functools.cache(complain)
        _make_private(self.path)
        self._depends = repr((settings, _surroundings())).encode()
        # Another run may be removing some too.
        with contextlib.suppress(FileNotFoundError):
            ours = [x for x in self.path.glob(f"*{_SUFFIX}") if x.is_file() and not x.is_symlink()]
            for path in sorted(ours, key=lambda path: path.stat().st_mtime)[:-_MAX_KEPT]:
                path.unlink()
            files.remove_unfinished(self.path)

    def find_or_trace(
        self, name: str, function: Function, args: PyTree, closed: object = ()
    ) -> Traced | None:
        """Finds a cached program, or traces and caches it; None if it cannot be exported.

        Its name, its arguments, and what it closes over besides the settings tell it from others. A
        line to standard error says why it cannot be loaded, exported or cached.
        """
        differs = repr((shapes_of(args), closed)).encode()
        digest = hashlib.sha256(self._depends + differs).hexdigest()[:32]
        path, traced = self.path / f"{name}-{digest}.stablehlo", None
        # A run must not end because this one or the next will be slower: a damaged file, a program
        # that calls something which JAX cannot export, a full disk.
        try:
            # A single wrong bit could end the process.
            structure, flat = pickle.loads(files.without_digest(path.read_bytes()))
            traced = Traced(export.deserialize(bytearray(flat)), structure)
            path.touch()
            return traced
        except FileNotFoundError:
            pass
        except Exception as error:
            self._tell(error)
        try:
            traced = trace(function, args)
            content = pickle.dumps((traced.structure, bytes(traced.flat.serialize())))
            files.write_digested(path, content, mode=0o600)
        except Exception as error:
            self._tell(error)
        return traced

    def _tell(self, error: Exception) -> None:
        """Tells once why programs are slower to start than they could be."""
        text = error.strerror if isinstance(error, OSError) else str(error)
        reason = f"{type(error).__name__} {text}".splitlines()[0]
        self._complain(f"jaxsense: {self.path}: a program must be traced again ({reason})")


def use_cache(directory: Path) -> None:
    """Makes JAX cache all compiled programs, also small ones, unless the user has set a cache.

    Raises:
      OSError: if the directory cannot be made, or if other users may write to it.
    """
    path = directory / "compiled"
    _make_private(path)
    # A cache that cannot be read or written, for example on a full disk, only costs time.
    warnings.filterwarnings("ignore", category=UserWarning, module=r"jax\._src\.compiler")
    if jax.config.values["jax_compilation_cache_dir"] is not None:
        return
    jax.config.update("jax_compilation_cache_dir", str(path))
    jax.config.update("jax_compilation_cache_max_size", _MAX_BYTES)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


def _make_private(path: Path) -> None:
    """Makes a directory private to this user; raises `OSError` if it exists and is not."""
    with contextlib.suppress(FileExistsError):
        path.mkdir(mode=0o700, parents=True)
    found = path.lstat()
    is_own = not hasattr(os, "getuid") or found.st_uid == os.getuid()
    if not (stat.S_ISDIR(found.st_mode) and is_own and not found.st_mode & 0o077):
        raise PermissionError(f"{path} must be a directory that you own, with mode 0700")


def _surroundings() -> list[object]:
    """Code, versions, options and devices, on which tracing depends."""
    variables = [(n, x) for n, x in os.environ.items() if n.startswith(("JAX_", "XLA_"))]
    options = [*variables, *((name, str(x)) for name, x in jax.config.values.items())]
    return [
        version.SOURCE,
        version.versions(),
        # Where compiled programs are cached leaves them unchanged.
        sorted((name, x) for name, x in options if "cache" not in name.lower()),
        jax.devices()[0].client.platform_version,
        [(device.platform, device.device_kind) for device in jax.devices()],
    ]


class Compiler(ThreadPoolExecutor):
    """Threads that compile the programs of a run, until the end of the block."""

    def __init__(self, monitor: Monitor, kept: Kept | None = None):
        super().__init__(devices.NUM_THREADS, "compile")
        self.monitor, self.kept = monitor, kept

    def __exit__(self, *_: object) -> None:
        """Cancels pending work, which would keep the process alive."""
        self.shutdown(wait=False, cancel_futures=True)


class Program:
    """A function of a stage, compiled in the background; a call blocks until it is compiled."""

    def __init__(self, compiler: Compiler, stage: str, name: str, closed: object = ()):
        """A program without a function yet; for `closed` see `Kept.find_or_trace`."""
        self._compiler, self._monitor = compiler, compiler.monitor
        self._stage, self._name, self._closed = stage, name, closed
        self._places: tuple[jax.sharding.NamedSharding, ...] | None = None
        self._compiled = Future[Function]()

    def compile(
        self,
        function: Function,
        *args: PyTree,
        mesh: Mesh | None = None,
        whole: int = 0,
        **options: bool,
    ) -> PyTree[jax.ShapeDtypeStruct]:
        """Traces a function, unless its trace is cached, and starts to compile it.

        Args:
          *args: arguments or their shapes.
          mesh: devices that share the rows of arguments and results; their number divides those.
          whole: number of arguments, the first ones, that every device gets undivided.
          **options: see `devices.compiler_options`.

        Returns:
          Shapes of the results.
        """
        with self.measure("compile_s"):
            lowered = self._lower(function, args, mesh, whole)

        def compile_lowered() -> Function:
            with self.measure("compile_s"):
                supported = devices.compiler_options(**options)
                compiled = lowered.compile(compiler_options=supported)
            devices.give_back_freed()
            return compiled

        self._compiled = self._compiler.submit(compile_lowered)
        return jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), lowered.out_info)

    def _lower(
        self, function: Function, args: tuple[PyTree, ...], mesh: Mesh | None, whole: int
    ) -> jax.stages.Lowered:
        """A function ready to be compiled; see `compile`."""
        shapes = shapes_of(args)
        share = devices.share(shapes, mesh, whole)
        traced, kept = None, self._compiler.kept
        if kept is not None:
            name = f"{self._stage}-{self._name}"
            traced = kept.find_or_trace(name, function, share, self._closed)
        if mesh is None:
            return jax.jit(function if traced is None else traced.__call__).lower(*shapes)
        # What devices run is traced apart; see `devices.spread`.
        try:
            traced = traced or trace(function, share)
        except NotImplementedError as error:
            reason = f"must be 1: {self._stage} cannot be split ({error})"
            raise ConfigError("devices", mesh.size, reason) from error
        spread = devices.spread(traced.__call__, mesh, len(args), whole)
        self._places = devices.places(mesh, len(args), whole)
        return jax.jit(spread, in_shardings=self._places).lower(*shapes)

    def measure(self, kind: Literal["compile_s", "run_s"]) -> AbstractContextManager[None]:
        """Adds the seconds of a block to those of the stage."""
        return self._monitor.measure(kind, self._stage)

    def cancel(self) -> None:
        """Does not compile the program, unless that has begun."""
        self._compiled.cancel()

    def wait(self) -> Function:
        """Blocks until the program is compiled; raises what `Monitor.check_stop` does."""
        if not self._compiled.done():
            self._monitor.progress(self._stage, 0, 0)
        return self._monitor.wait_for(self._compiled)

    def run(self, *args: PyTree) -> PyTree[jax.Array]:
        """Runs the program, and returns before its results are ready."""
        compiled = self.wait()
        if self._places is not None:
            put = devices.put if jax.process_count() > 1 else jax.device_put
            args = tuple(map(put, args, self._places))
        return compiled(*args)

    def __call__(self, *args: PyTree) -> PyTree[jax.Array]:
        """Runs the program, and blocks until its results are ready."""
        self.wait()
        with self.measure("run_s"):
            return jax.block_until_ready(self.run(*args))


class RowProgram:
    """A program whose arguments and results are independent rows, which workers share.

    Threads take a few rows at a time, devices of a mesh all at once. Results lie on the host.
    """

    def __init__(self, program: Program, workers: Workers):
        self._program, self._workers = program, workers

    def compile(
        self, function: Function, *args: PyTree, whole: int
    ) -> PyTree[jax.ShapeDtypeStruct]:
        """Compiles it for as many rows as a call takes; see `Program.compile`."""
        shapes, threads, mesh = shapes_of(args), self._workers.threads, self._workers.mesh
        self._whole, number = whole, len(jax.tree.leaves(args[whole:])[0])
        calls = 1 if mesh is not None else threads * -(-number // (threads * _ROWS_AT_ONCE))
        devices_of_call = 1 if mesh is None else mesh.size
        size = devices_of_call * -(-number // (calls * devices_of_call))
        # Where rows cannot be divided, the last call takes the first ones again.
        self._rows = [np.arange(i * size, (i + 1) * size) % number for i in range(calls)]
        some = jax.tree.map(lambda x: x.update(shape=(size, *x.shape[1:])), shapes[whole:])
        results = self._program.compile(function, *shapes[:whole], *some, mesh=mesh, whole=whole)
        self._results = jax.tree.map(lambda x: x.update(shape=(number, *x.shape[1:])), results)
        return self._results

    def cancel(self) -> None:
        """See `Program.cancel`."""
        self._program.cancel()

    def __call__(self, *args: PyTree) -> PyTree[np.ndarray]:
        """Runs the program for all rows."""
        self._program.wait()
        results = jax.tree.map(devices.empty, self._results)

        def run(rows: np.ndarray) -> None:
            some = jax.tree.map(lambda x: x[rows], args[self._whole :])
            found = devices.fetched(self._program.run(*args[: self._whole], *some))
            for all_rows, new in zip(*map(jax.tree.leaves, (results, found)), strict=True):
                all_rows[rows] = new

        with self._program.measure("run_s"):
            devices.side_by_side(run, self._rows, self._workers.threads)
        return results
