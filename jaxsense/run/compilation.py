"""Compiles programs in the background, and keeps them for later runs."""

import contextlib
import hashlib
import os
import platform
import re
import stat
import time
import warnings
from collections.abc import Callable
from concurrent.futures import CancelledError, Future, InvalidStateError, ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any

import jax
import optax
from jax import export
from jax.experimental import multihost_utils

from jaxsense.run import devices, files
from jaxsense.run.devices import ALONE, Workers
from jaxsense.run.monitor import Monitor
from jaxsense.run.version import versions

# Read at import, so that it matches the code that runs.
_SOURCE = [
    (path.name, hashlib.sha256(path.read_bytes()).hexdigest())
    for path in sorted(Path(__file__).parents[1].rglob("*.py"))
]
_MOST_KEPT = 512  # traced programs; a run has about twenty
_MOST_BYTES = 2**31  # of compiled programs
_FILE = re.compile(r"[a-z0-9_]+-[a-z]+-[0-9a-f]{32}\.stablehlo")

for _state in (optax.ScaleByAdamState, optax.ScaleByScheduleState, optax.EmptyState):
    export.register_namedtuple_serialization(_state, serialized_name=f"optax.{_state.__name__}")


class Kept:
    """Programs of earlier runs, in a directory.

    JAX's compilation cache finds compiled programs by their traces. This directory keeps the traces
    and finds them by all that tracing depends on: tracing takes as long as all the rest.

    Attributes:
      path: the directory of traced programs.
    """

    def __init__(self, directory: Path, *settings: Any):
        """Opens the directory, and removes the least recently used programs.

        Args:
          directory: where programs are kept, and JAX's compilation cache.
          *settings: all that programs close over outside jaxsense's source, as values that differ
            in their `repr`.

        Raises:
          OSError: if the directory cannot be made, or other users may write it: a program that is
            loaded is code that runs.
        """
        self.path = directory / "traced"
        _make_private(self.path)
        _make_private(directory / "compiled")
        self._depends = repr((settings, _SOURCE, _surroundings())).encode()
        # Another run may remove some at the same time.
        with contextlib.suppress(FileNotFoundError):
            self._forget_oldest()
        _use_cache_of_jax(directory / "compiled")

    def _forget_oldest(self) -> None:
        """Removes the least recently used programs, and nothing else."""
        ours = [
            path
            for path in self.path.iterdir()
            if _FILE.fullmatch(path.name) and path.is_file() and not path.is_symlink()
        ]
        for path in sorted(ours, key=lambda path: path.stat().st_mtime)[:-_MOST_KEPT]:
            path.unlink(missing_ok=True)
        files.remove_unfinished(self.path)

    def find(self, name: str, args: Any) -> export.Exported | None:
        """Finds a kept program.

        Args:
          name: of the program.
          args: its arguments or their shapes.

        Returns:
          The traced program; None if its file is missing or damaged.
        """
        # Whatever is wrong with a file, tracing again repairs it.
        with contextlib.suppress(Exception):
            path = self._file(name, args)
            with path.open("rb") as file:
                if not _is_private(os.fstat(file.fileno()), 0o022):
                    return None
                content = file.read()
            # A single wrong bit could end the process.
            found = export.deserialize(bytearray(files.without_digest(content)))
            path.touch()
            return found
        return None

    def find_or_trace(
        self, name: str, function: Callable[..., Any], args: Any
    ) -> export.Exported | None:
        """A kept program, or a new one that is kept from now on; None if JAX cannot export it."""
        found = self.find(name, args)
        if found is not None:
            return found
        leaves, tree = jax.tree.flatten(args)
        flat = jax.jit(lambda *leaves: function(*jax.tree.unflatten(tree, leaves)))
        # A run must not end because the next one will be slower: on a full disk, or where your own
        # sensor calls something that JAX cannot export.
        with contextlib.suppress(Exception):
            traced = export.export(flat)(*shapes_of(leaves))
            content = files.with_digest(bytes(traced.serialize()))
            files.write(self._file(name, args), content, mode=0o600)
            return traced
        return None

    def _file(self, name: str, args: Any) -> Path:
        """The file of a program."""
        shapes = repr(shapes_of(args)).encode()
        digest = hashlib.sha256(self._depends + shapes).hexdigest()[:32]
        return self.path / f"{name}-{digest}.stablehlo"


def _use_cache_of_jax(path: Path) -> None:
    """Sets JAX's compilation cache, also for small programs, unless the user has set it."""
    # A cache that cannot be read or written costs time, on a full disk for example, and no result.
    warnings.filterwarnings("ignore", category=UserWarning, module=r"jax\._src\.compiler")
    if jax.config.values["jax_compilation_cache_dir"] is not None:
        return
    jax.config.update("jax_compilation_cache_dir", str(path))
    jax.config.update("jax_compilation_cache_max_size", _MOST_BYTES)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


class Compiler:
    """Compiles the programs of a run in its own threads.

    Attributes:
      monitor: receives the time that it takes.
      kept: where programs are kept, if anywhere.
    """

    def __init__(self, monitor: Monitor, kept: Kept | None = None):
        self.monitor, self.kept = monitor, kept
        self._threads = ThreadPoolExecutor(devices.NUM_THREADS)
        self._is_closed = False

    def __enter__(self) -> "Compiler":
        return self

    def __exit__(self, *error: Any) -> None:
        """Cancels what still waits, which would otherwise hold up the process."""
        self._is_closed = True
        self._threads.shutdown(wait=False, cancel_futures=True)

    def check_open(self) -> None:
        """Raises `CancelledError` once the run is over."""
        if self._is_closed:
            raise CancelledError

    def submit(self, work: Callable[[], None]) -> None:
        """Runs `work` in one of the threads."""
        self._threads.submit(work)


class Program:
    """A function of a stage, compiled in the background.

    Callable before `compile`, from another thread; blocks until compiled.
    """

    def __init__(self, compiler: Compiler, stage: str, name: str):
        """Names a program, uniquely within a stage of a run."""
        self._compiler, self._monitor = compiler, compiler.monitor
        self._stage, self._name = stage, name
        self._compiled: Future[Callable[..., Any]] = Future()
        self._workers, self._whole = ALONE, ()

    def compile(
        self,
        function: Callable[..., Any],
        *args: Any,
        runs_long: bool = False,
        workers: Workers = ALONE,
        whole: tuple[int, ...] = (),
    ) -> Any:
        """Traces a function, unless its trace was kept, and starts to compile it.

        Args:
          function: what to compile.
          *args: arguments or their shapes, for example the result of another program's `compile`.
          runs_long: see `devices.compiler_options`.
          workers: what shares the rows of the arguments; their number divides the rows.
          whole: positions of arguments that every worker gets undivided.

        Returns:
          Shapes and dtypes of the results, as a pytree.
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
                options = devices.compiler_options(runs_long=runs_long)
                compiled = lowered.compile(compiler_options=options)
            except Exception as error:
                self.fail(error)
                return
            self._monitor.add(self._stage, "compile_s", time.perf_counter() - begin)
            with contextlib.suppress(InvalidStateError):  # failed already for another reason
                self._compiled.set_result(compiled)

        self._compiler.submit(compile_lowered)
        return devices.of_all_parts(results, workers.threads)

    def _lower(self, function: Callable[..., Any], args: Any) -> tuple[jax.stages.Lowered, Any]:
        """A function ready to be compiled, and the shapes of its results; see `compile`."""
        kept = self._compiler.kept
        # A program split over devices cannot be called from one that is not.
        if kept is not None and self._workers.mesh is None:
            found = kept.find_or_trace(f"{self._stage}-{self._name}", function, args)
            if found is not None:
                call = jax.jit(lambda *args: found.call(*jax.tree.leaves(args)))
                avals = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in found.out_avals]
                return call.lower(*shapes_of(args)), jax.tree.unflatten(found.out_tree, avals)
        options: dict[str, Any] = {}
        if self._is_of_many:
            assert self._workers.mesh is not None
            places = devices.shardings(self._workers.mesh, len(args), self._whole)
            options = {"in_shardings": places}
        traced = jax.jit(function, **options).trace(*args)
        return traced.lower(), traced.out_info

    @property
    def _is_of_many(self) -> bool:
        """Whether several processes run the program together."""
        return self._workers.mesh is not None and jax.process_count() > 1

    def fail(self, error: BaseException) -> None:
        """Makes all calls raise an error, unless the program is compiled already."""
        with contextlib.suppress(InvalidStateError):
            self._compiled.set_exception(error)

    def wait(self) -> Callable[..., Any]:
        """Blocks until compiled and returns the program; raises `Stopped` if the run must stop."""
        if not self._compiled.done():
            self._monitor.announce(self._stage)
        while not self._compiled.done():
            self._monitor.check_stop()
            wait((self._compiled,), timeout=0.2)
        return self._compiled.result()

    def __call__(self, *args: Any) -> Any:
        """Runs the program, and blocks until its results are ready."""
        compiled = self.wait()
        begin, number = time.perf_counter(), self._workers.threads

        if self._is_of_many:
            assert self._workers.mesh is not None
            args = devices.put(args, devices.shardings(self._workers.mesh, len(args), self._whole))

        def run(i: int) -> Any:
            return jax.block_until_ready(compiled(*devices.part(args, i, number, self._whole)))

        output = devices.joined(devices.side_by_side(run, number))
        if self._is_of_many:
            output = multihost_utils.process_allgather(output, tiled=True)
        self._monitor.add(self._stage, "run_s", time.perf_counter() - begin)
        return output


def shapes_of(args: Any) -> Any:
    """Shapes and dtypes of arguments; Python numbers count as those of JAX."""
    return jax.eval_shape(lambda args: args, args)


def _make_private(path: Path) -> None:
    """Makes a directory private to this user; raises `OSError` if it exists and is not."""
    with contextlib.suppress(FileExistsError):
        path.mkdir(mode=0o700, parents=True)
    found = path.lstat()
    if not (stat.S_ISDIR(found.st_mode) and _is_private(found, 0o077)):
        raise PermissionError(f"{path} must be a directory of yours alone, with mode 0700")


def _is_private(found: os.stat_result, others: int) -> bool:
    """Whether a file belongs to this user, and others have none of these rights."""
    is_own = not hasattr(os, "getuid") or found.st_uid == os.getuid()
    return is_own and found.st_mode & others == 0


def _surroundings() -> list[Any]:
    """All else that tracing and compiling depend on: versions, options, devices and processor."""
    features = set()
    with contextlib.suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
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
    """Whether an option sets where and how JAX keeps what it compiles: it changes no program."""
    return "cache" in option.lower()
