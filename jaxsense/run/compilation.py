"""Compiles programs in the background and caches their traces for later runs."""

import contextlib
import hashlib
import os
import pickle
import platform
import re
import stat
import time
import warnings
from collections.abc import Callable
from concurrent.futures import CancelledError, Future, InvalidStateError, ThreadPoolExecutor, wait
from pathlib import Path
from types import TracebackType
from typing import NamedTuple, TypeAlias

import jax
from jax import export
from jaxtyping import PyTree

from jaxsense.run import devices, files
from jaxsense.run.devices import ALONE, Workers
from jaxsense.run.monitor import Monitor
from jaxsense.run.version import versions

Function: TypeAlias = Callable[..., PyTree]

# Read at import, so that it matches the code that runs.
_SOURCE = [
    (path.name, hashlib.sha256(path.read_bytes()).hexdigest())
    for path in sorted(Path(__file__).parents[1].rglob("*.py"))
]
_MAX_KEPT = 512  # traced programs; a run has about twenty
_MAX_BYTES = 2**31  # of compiled programs
_FILE = re.compile(r".+-[0-9a-f]{32}\.stablehlo")
_CPU_INFO = Path("/proc/cpuinfo")


class Traced(NamedTuple):
    """A traced program that takes and returns flat leaves, and the structure of its results.

    `jax.export` could write structures itself, but only of classes that are registered with it,
    once per process and name.
    """

    flat: export.Exported
    structure: object

    @property
    def results(self) -> PyTree[jax.ShapeDtypeStruct]:
        """Shapes and dtypes of the results."""
        avals = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in self.flat.out_avals]
        return jax.tree.unflatten(self.structure, avals)

    def __call__(self, *args: PyTree) -> PyTree:
        """Calls the program with arguments of the structure with which it was traced."""
        leaves = self.flat.call(*jax.tree.leaves(args))
        return jax.tree.unflatten(self.structure, leaves)


class Kept:
    """Cache of traced programs in a directory.

    JAX's compilation cache finds compiled programs by their traces. Tracing takes as long as
    everything else, so this directory holds the traces, found by all that tracing depends on.

    Attributes:
      path: the directory of traced programs.
    """

    def __init__(self, directory: Path, *settings: object):
        """Opens the cache, and removes the least recently used programs.

        Args:
          directory: holds the traced programs, and JAX's compilation cache.
          *settings: everything outside jaxsense's source that programs close over, as values whose
            `repr` tells them apart.

        Raises:
          OSError: if the directory cannot be made, or if other users may write to it: loading a
            program runs it.
        """
        use_cache(directory)
        self.path = directory / "traced"
        _make_private(self.path)
        self._depends = repr((settings, _SOURCE, _surroundings())).encode()
        # Another run may be removing some too.
        with contextlib.suppress(FileNotFoundError):
            self._forget_oldest()

    def _forget_oldest(self) -> None:
        """Removes the least recently used programs, and no other file."""
        ours = [
            path
            for path in self.path.iterdir()
            if _FILE.fullmatch(path.name) and path.is_file() and not path.is_symlink()
        ]
        for path in sorted(ours, key=lambda path: path.stat().st_mtime)[:-_MAX_KEPT]:
            path.unlink(missing_ok=True)
        files.remove_unfinished(self.path)

    def find(self, name: str, args: PyTree) -> Traced | None:
        """Finds a cached program.

        Args:
          name: of the program.
          args: its arguments or their shapes.

        Returns:
          The program; None if its file is missing or damaged.
        """
        # Tracing the program again repairs any file.
        with contextlib.suppress(Exception):
            path = self._file(name, args)
            with path.open("rb") as file:
                if not _is_private(os.fstat(file.fileno()), 0o022):
                    return None
                content = file.read()
            # A single wrong bit could end the process.
            structure, flat = pickle.loads(files.without_digest(content))
            found = Traced(export.deserialize(bytearray(flat)), structure)
            path.touch()
            return found
        return None

    def find_or_trace(self, name: str, function: Function, args: PyTree) -> Traced | None:
        """Finds a cached program, or traces and caches a new one.

        Args:
          name: of the program.
          function: what to trace.
          args: its arguments or their shapes.

        Returns:
          The program; None if it cannot be exported or written.
        """
        found = self.find(name, args)
        if found is not None:
            return found
        leaves, structure = jax.tree.flatten(args)
        results: list[object] = []

        def flat(*leaves: jax.Array) -> list[jax.Array]:
            output = function(*jax.tree.unflatten(structure, leaves))
            results.append(jax.tree.structure(output))
            return jax.tree.leaves(output)

        # A run must not end because the next one will be slower: on a full disk, or where a
        # program calls something that JAX cannot export.
        with contextlib.suppress(Exception):
            traced = Traced(export.export(jax.jit(flat))(*shapes_of(leaves)), results[-1])
            content = pickle.dumps((traced.structure, bytes(traced.flat.serialize())))
            files.write(self._file(name, args), files.with_digest(content), mode=0o600)
            return traced
        return None

    def _file(self, name: str, args: PyTree) -> Path:
        """The file of a program."""
        shapes = repr(shapes_of(args)).encode()
        digest = hashlib.sha256(self._depends + shapes).hexdigest()[:32]
        return self.path / f"{name}-{digest}.stablehlo"


def use_cache(directory: Path) -> None:
    """Makes JAX cache all compiled programs, also small ones, unless the user has set a cache.

    Args:
      directory: holds them, in `compiled`.

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


class Compiler:
    """Compiles the programs of a run in its own threads.

    Attributes:
      monitor: receives compile times.
      kept: cache of traced programs, if any.
    """

    def __init__(self, monitor: Monitor, kept: Kept | None = None):
        self.monitor, self.kept = monitor, kept
        self._threads = ThreadPoolExecutor(devices.NUM_THREADS)
        self._is_closed = False

    def __enter__(self) -> "Compiler":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Cancels pending work, which would keep the process alive."""
        self._is_closed = True
        self._threads.shutdown(wait=False, cancel_futures=True)

    def check_open(self) -> None:
        """Checks that the run is not over.

        Raises:
          CancelledError: if it is.
        """
        if self._is_closed:
            raise CancelledError

    def submit(self, work: Callable[[], None]) -> None:
        """Runs `work` in one of the threads."""
        self._threads.submit(work)


class Program:
    """A function of a stage, compiled in the background.

    May be called before `compile`, from another thread; the call blocks until it is compiled.
    """

    def __init__(self, compiler: Compiler, stage: str, name: str):
        """Names a program.

        Args:
          compiler: compiles it.
          stage: to which it belongs.
          name: unique within the stage.
        """
        self._compiler, self._monitor = compiler, compiler.monitor
        self._stage, self._name = stage, name
        self._compiled: Future[Function] = Future()
        self._workers, self._whole = ALONE, ()

    def compile(
        self,
        function: Function,
        *args: PyTree,
        workers: Workers = ALONE,
        whole: tuple[int, ...] = (),
        **options: bool,
    ) -> PyTree[jax.ShapeDtypeStruct]:
        """Traces a function, unless its trace is cached, and starts to compile it.

        Args:
          function: what to compile.
          *args: arguments or their shapes, for example the result of another program's `compile`.
          workers: share the rows of the arguments; their number must divide the rows.
          whole: positions of arguments that every worker gets undivided.
          **options: see `devices.compiler_options`.

        Returns:
          Shapes and dtypes of the results.

        Raises:
          CancelledError: if the run is over.
        """
        self._compiler.check_open()
        begin = time.perf_counter()
        self._workers, self._whole = workers, whole
        function = devices.spread(function, workers.mesh, whole)
        args = devices.part(args, 0, workers.threads, whole)
        lowered, results = self._lower(function, args)
        self._monitor.add(self._stage, "compile_s", time.perf_counter() - begin)

        def compile_lowered() -> None:
            begin = time.perf_counter()
            try:
                compiled = lowered.compile(compiler_options=devices.compiler_options(**options))
            except Exception as error:
                self.fail(error)
                return
            self._monitor.add(self._stage, "compile_s", time.perf_counter() - begin)
            with contextlib.suppress(InvalidStateError):  # `fail` was called before
                self._compiled.set_result(compiled)

        self._compiler.submit(compile_lowered)
        return devices.of_all_parts(results, workers.threads)

    def _lower(self, function: Function, args: PyTree) -> tuple[jax.stages.Lowered, PyTree]:
        """A function ready to be compiled, and the shapes of its results; see `compile`."""
        kept = self._compiler.kept
        # A program split over devices cannot be called from one that is not.
        if kept is not None and self._workers.mesh is None:
            found = kept.find_or_trace(f"{self._stage}-{self._name}", function, args)
            if found is not None:
                return jax.jit(found.__call__).lower(*shapes_of(args)), found.results
        places = self._places(len(args)) if self._is_of_many else None
        traced = jax.jit(function, in_shardings=places).trace(*args)
        return traced.lower(), traced.out_info

    @property
    def _is_of_many(self) -> bool:
        """Whether several processes run the program together."""
        return self._workers.mesh is not None and jax.process_count() > 1

    def _places(self, number: int) -> tuple[jax.sharding.NamedSharding, ...]:
        """Where each of a number of arguments lies, if several processes run the program."""
        assert self._workers.mesh is not None
        return devices.shardings(self._workers.mesh, number, self._whole)

    def fail(self, error: BaseException) -> None:
        """Makes all calls raise an error, unless the program is compiled already."""
        with contextlib.suppress(InvalidStateError):
            self._compiled.set_exception(error)

    def wait(self) -> Function:
        """Blocks until the program is compiled.

        Returns:
          The compiled program.

        Raises:
          Stopped: if the run must stop.
          StageError: if a concurrent stage failed.
        """
        if not self._compiled.done():
            self._monitor.announce(self._stage)
        while not self._compiled.done():
            self._monitor.check_stop()
            wait((self._compiled,), timeout=0.2)
        return self._compiled.result()

    def run(self, *args: PyTree) -> PyTree[jax.Array]:
        """Runs a program that threads do not share, and leaves its results on the devices."""
        compiled = self.wait()
        if self._is_of_many:
            args = devices.put(args, self._places(len(args)))
        return compiled(*args)

    def __call__(self, *args: PyTree) -> PyTree:
        """Runs the program, and blocks until its results are ready."""
        compiled = self.wait()
        begin, number = time.perf_counter(), self._workers.threads

        if self._is_of_many:
            args = devices.put(args, self._places(len(args)))

        def run(i: int) -> PyTree:
            return jax.block_until_ready(compiled(*devices.part(args, i, number, self._whole)))

        output = devices.joined(devices.side_by_side(run, number))
        if self._is_of_many:
            output = devices.fetched(output)
        self._monitor.add(self._stage, "run_s", time.perf_counter() - begin)
        return output


def shapes_of(args: PyTree) -> PyTree[jax.ShapeDtypeStruct]:
    """Shapes and dtypes of arguments; Python numbers count as JAX arrays."""
    return jax.eval_shape(lambda args: args, args)


def _make_private(path: Path) -> None:
    """Makes a directory private to this user; raises `OSError` if it exists and is not."""
    with contextlib.suppress(FileExistsError):
        path.mkdir(mode=0o700, parents=True)
    found = path.lstat()
    if not (stat.S_ISDIR(found.st_mode) and _is_private(found, 0o077)):
        raise PermissionError(f"{path} must be a directory that you own, with mode 0700")


def _is_private(found: os.stat_result, others: int) -> bool:
    """Whether this user owns a file, and other users have none of the rights `others`."""
    is_own = not hasattr(os, "getuid") or found.st_uid == os.getuid()
    return is_own and found.st_mode & others == 0


def _surroundings() -> list[object]:
    """Versions, options, devices and processor, on which tracing and compiling depend."""
    features = set()
    with contextlib.suppress(OSError):
        lines = _CPU_INFO.read_text(encoding="utf-8").splitlines()
        features = {line for line in lines if line.startswith(("flags", "model name", "Features"))}
    variables = [item for item in os.environ.items() if item[0].startswith(("JAX_", "XLA_"))]
    return [
        versions(),
        sorted((name, value) for name, value in variables if not _sets_cache(name)),
        sorted((name, str(x)) for name, x in jax.config.values.items() if not _sets_cache(name)),
        jax.devices()[0].client.platform_version,
        [(device.platform, device.device_kind) for device in jax.devices()],
        sorted(features),
        platform.python_version(),
    ]


def _sets_cache(option: str) -> bool:
    """Whether an option only concerns JAX's cache and leaves programs unchanged."""
    return "cache" in option.lower()
