"""Programs that are compiled in the background, and kept for later runs."""

import contextlib
import hashlib
import importlib.metadata
import os
import platform
import re
import stat
import time
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

_THREADS = min(os.cpu_count() or 1, 8)
_PACKAGES = ("jax", "jaxlib", "flax", "optax", "mujoco", "mujoco-mjx", "numpy")
_DIGEST = hashlib.sha256().digest_size
# Read when it is imported, as the rest of it is then.
_SOURCE = [
    (path.name, hashlib.sha256(path.read_bytes()).hexdigest())
    for path in sorted(Path(__file__).parents[1].rglob("*.py"))
]
_MOST_KEPT = 512  # traced programs, of which a run has some twenty
_MOST_BYTES = 2**31  # of compiled programs
_FILE = re.compile(r"[a-z0-9_]+-[a-z]+-[0-9a-f]{32}\.stablehlo")

for _state in (optax.ScaleByAdamState, optax.ScaleByScheduleState, optax.EmptyState):
    export.register_namedtuple_serialization(_state, serialized_name=f"optax.{_state.__name__}")


class Kept:
    """Programs of former runs, in a directory.

    JAX's compilation cache keeps what is compiled, in a directory of its own, and finds it by what
    tracing yields. Here lies what tracing yields, found by all that tracing depends on, so that
    nothing is traced again: that takes as long as all the rest.

    Attributes:
      path: the directory of traced programs.
    """

    def __init__(self, directory: Path, *settings: Any):
        """Finds the programs that were kept, and forgets those that were not used for longest.

        Args:
          directory: where programs are kept; JAX is told to keep its own there.
          *settings: all that programs close over and that is not in jaxsense's source, as values
            whose `repr` tells them apart.

        Raises:
          OSError: if the directory cannot be made, or others than this user may write it: a program
            that is loaded is code that is run.
        """
        self.path = directory / "traced"
        _make_private(self.path)
        _make_private(directory / "compiled")
        self._depends = repr((settings, _SOURCE, _surroundings())).encode()
        # Another run may forget some at the same time.
        with contextlib.suppress(FileNotFoundError):
            self._forget_oldest()
        _use_cache_of_jax(directory / "compiled")

    def _forget_oldest(self) -> None:
        """Removes programs that were not used for longest, and nothing else."""
        ours = [
            path
            for path in self.path.iterdir()
            if _FILE.fullmatch(path.name) and path.is_file() and not path.is_symlink()
        ]
        for path in sorted(ours, key=lambda path: path.stat().st_mtime)[:-_MOST_KEPT]:
            path.unlink(missing_ok=True)
        files.remove_unfinished(self.path)

    def find(self, name: str, args: Any) -> export.Exported | None:
        """A program that was kept.

        Args:
          name: of the program.
          args: its arguments or their shapes.

        Returns:
          The traced program; None if it is not there or its file is damaged.
        """
        # Whatever is wrong with a file, tracing again mends it.
        with contextlib.suppress(Exception):
            path = self._file(name, args)
            with path.open("rb") as file:
                if not _is_private(os.fstat(file.fileno()), 0o022):
                    return None
                content = file.read()
            digest, program = content[:_DIGEST], content[_DIGEST:]
            # A single wrong bit could end the process.
            if hashlib.sha256(program).digest() == digest:
                found = export.deserialize(bytearray(program))
                path.touch()
                return found
        return None

    def find_or_trace(
        self, name: str, function: Callable[..., Any], args: Any
    ) -> export.Exported | None:
        """A program that was kept, or is kept from now on; None if JAX cannot write it down."""
        found = self.find(name, args)
        if found is not None:
            return found
        leaves, tree = jax.tree.flatten(args)
        flat = jax.jit(lambda *leaves: function(*jax.tree.unflatten(tree, leaves)))
        # A run must not end because the next one will be slower: on a full disk, or where a sensor
        # of the user's own calls something that JAX does not promise to find again.
        with contextlib.suppress(Exception):
            traced = export.export(flat)(*_shapes(leaves))
            program = bytes(traced.serialize())
            content = hashlib.sha256(program).digest() + program
            files.write(self._file(name, args), content, mode=0o600)
            return traced
        return None

    def _file(self, name: str, args: Any) -> Path:
        """Where a program is kept."""
        shapes = repr(jax.eval_shape(lambda args: args, args)).encode()
        digest = hashlib.sha256(self._depends + shapes).hexdigest()[:32]
        return self.path / f"{name}-{digest}.stablehlo"


def _use_cache_of_jax(path: Path) -> None:
    """Lets JAX keep what it compiles, also small programs, unless the user has told it where."""
    if jax.config.values["jax_compilation_cache_dir"] is not None:
        return
    jax.config.update("jax_compilation_cache_dir", str(path))
    jax.config.update("jax_compilation_cache_max_size", _MOST_BYTES)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


class Compiler:
    """Compiles the programs of a run in threads of its own.

    Attributes:
      monitor: is told how long it takes.
      kept: where programs are kept, if anywhere.
    """

    def __init__(self, monitor: Monitor, kept: Kept | None = None):
        self.monitor, self.kept = monitor, kept
        self._threads = ThreadPoolExecutor(_THREADS)
        self._is_closed = False

    def __enter__(self) -> "Compiler":
        return self

    def __exit__(self, *error: Any) -> None:
        """Gives up what is still waiting, or else the process would go on with it."""
        self._is_closed = True
        self._threads.shutdown(wait=False, cancel_futures=True)

    def check_open(self) -> None:
        """Raises `CancelledError` if the run is over."""
        if self._is_closed:
            raise CancelledError

    def submit(self, work: Callable[[], None]) -> None:
        """Runs something in one of the threads."""
        self._threads.submit(work)


class Program:
    """A function of a stage that is compiled in the background; a call waits for that and runs it.

    It may be called, from another thread, before it is known what it does.
    """

    def __init__(self, compiler: Compiler, stage: str, name: str):
        """Names a program; no other of the same run may have this name in this stage."""
        self._compiler, self._monitor = compiler, compiler.monitor
        self._stage, self._name = stage, name
        self._compiled: Future[Callable[..., Any]] = Future()
        self._workers, self._whole = ALONE, ()

    @property
    def num_workers(self) -> int:
        """Who shares the rows of the arguments; known once the program is compiled."""
        self.wait()
        return self._workers.number

    def compile(
        self,
        function: Callable[..., Any],
        *args: Any,
        runs_long: bool = False,
        workers: Workers = ALONE,
        whole: tuple[int, ...] = (),
    ) -> Any:
        """Traces a function, unless that was kept, and begins to compile it.

        Args:
          function: what to compile.
          *args: arguments or their shapes, for example the result of another program's `compile`.
          runs_long: see `devices.compiler_options`.
          workers: who shares the rows of the arguments; their number divides the rows.
          whole: positions of arguments that every worker gets as they are.

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
            with contextlib.suppress(InvalidStateError):  # it has failed for another reason
                self._compiled.set_result(compiled)

        self._compiler.submit(compile_lowered)
        return devices.of_all_parts(results, workers.threads)

    def _lower(self, function: Callable[..., Any], args: Any) -> tuple[jax.stages.Lowered, Any]:
        """A function ready to be compiled, and the shapes of its results; see `compile`."""
        kept = self._compiler.kept
        # What is split over devices cannot be called from a program that is not.
        if kept is not None and self._workers.mesh is None:
            found = kept.find_or_trace(f"{self._stage}-{self._name}", function, args)
            if found is not None:
                call = jax.jit(lambda *args: found.call(*jax.tree.leaves(args)))
                avals = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in found.out_avals]
                return call.lower(*_shapes(args)), jax.tree.unflatten(found.out_tree, avals)
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
        """Raises an error from all calls, unless the program is there already."""
        with contextlib.suppress(InvalidStateError):
            self._compiled.set_exception(error)

    def wait(self) -> Callable[..., Any]:
        """Waits until the program is compiled, and gives it; `Stopped` if the run is to stop."""
        if not self._compiled.done():
            self._monitor.announce(self._stage)
        while not self._compiled.done():
            self._monitor.check_stop()
            wait((self._compiled,), timeout=0.2)
        return self._compiled.result()

    def __call__(self, *args: Any) -> Any:
        """Runs the program until its results are there."""
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


def _shapes(args: Any) -> Any:
    """Shapes and dtypes of arguments; a number of Python is one of JAX."""
    return jax.eval_shape(lambda args: args, args)


def _make_private(path: Path) -> None:
    """Makes a directory of this user's alone; an `OSError` says if one is there that is not."""
    with contextlib.suppress(FileExistsError):
        path.mkdir(mode=0o700, parents=True)
    found = path.lstat()
    if not (stat.S_ISDIR(found.st_mode) and _is_private(found, 0o077)):
        raise PermissionError(f"{path} must be a directory of yours alone, with mode 0700")


def _is_private(found: os.stat_result, others: int) -> bool:
    """Whether something is this user's, and gives others none of these rights."""
    is_own = not hasattr(os, "getuid") or found.st_uid == os.getuid()
    return is_own and found.st_mode & others == 0


def _surroundings() -> list[Any]:
    """What else tracing and compiling depend on: versions, options, devices and processor."""
    features = set()
    with contextlib.suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        features = {line for line in lines if line.startswith(("flags", "model name", "Features"))}
    return [
        [(package, importlib.metadata.version(package)) for package in _PACKAGES],
        sorted((k, v) for k, v in os.environ.items() if k.startswith(("JAX_", "XLA_"))),
        sorted((name, str(value)) for name, value in jax.config.values.items()),
        jax.devices()[0].client.platform_version,
        [(device.platform, device.device_kind) for device in jax.devices()],
        sorted(features),
        platform.python_version(),
    ]
