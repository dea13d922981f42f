"""Programs that are compiled in the background, and kept for later runs."""

import contextlib
import dataclasses
import hashlib
import importlib.metadata
import os
import pickle
import platform
import re
import stat
import time
from collections.abc import Callable
from concurrent.futures import CancelledError, Future, InvalidStateError, ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from jax.experimental import serialize_executable

from jaxsense import devices
from jaxsense.devices import ALONE, Workers
from jaxsense.monitor import Monitor

_THREADS = min(os.cpu_count() or 1, 8)
_PACKAGES = ("jax", "jaxlib", "flax", "optax", "mujoco", "mujoco-mjx", "numpy")
_DIGEST = hashlib.sha256().digest_size
# Read when it is imported, as the rest of it is then.
_SOURCE = [
    (path.name, hashlib.sha256(path.read_bytes()).hexdigest())
    for path in sorted(Path(__file__).parent.rglob("*.py"))
]
_MOST_KEPT = 8  # runs with different settings
_FOLDER = re.compile(r"[0-9a-f]{32}")
_FILE = re.compile(r".+-[0-9a-f]{16}\.(pickle|\d+)")


class Kept:
    """Compiled programs in a directory.

    JAX's own compilation cache finds a program by what tracing it gives; here it is found by all
    that tracing depends on, so that it need not be traced, which takes as long as all the rest.

    Attributes:
      path: the directory of the programs with these dependencies.
    """

    def __init__(self, directory: Path, *settings: Any):
        """Finds the programs that were kept for these settings, and forgets the oldest others.

        Args:
          directory: where programs are kept.
          *settings: all that programs close over and that is not in jaxsense's source, as values
            whose `repr` tells them apart.

        Raises:
          OSError: if the directory cannot be made, or others than this user may write it: a program
            that is loaded is code that is run.
        """
        text = repr((settings, _SOURCE, _surroundings())).encode()
        self.path = directory / "executables" / hashlib.sha256(text).hexdigest()[:32]
        _make_private(self.path.parent)
        _make_private(self.path)
        self.path.touch()
        # Another run may forget some at the same time.
        with contextlib.suppress(FileNotFoundError):
            self._forget_oldest()

    def _forget_oldest(self) -> None:
        """Removes programs of settings that were not used for longest, and nothing else."""
        others = [
            path
            for path in self.path.parent.iterdir()
            if _FOLDER.fullmatch(path.name) and path.is_dir() and not path.is_symlink()
        ]
        others.sort(key=lambda path: path.lstat().st_mtime)
        for folder in others[:-_MOST_KEPT]:
            for path in folder.iterdir():
                if _FILE.fullmatch(path.name):
                    path.unlink(missing_ok=True)
            # Not empty, if it holds anything that is not ours.
            with contextlib.suppress(OSError):
                folder.rmdir()

    def find(self, name: str, args: Any) -> "Found | None":
        """A program that was kept.

        Args:
          name: of the program.
          args: its arguments or their shapes.

        Returns:
          The program; None if it is not there or its file is damaged.
        """
        # Whatever is wrong with a file, compiling again mends it.
        with contextlib.suppress(Exception):
            with self._file(name, args).open("rb") as file:
                if not _is_private(os.fstat(file.fileno()), 0o022):
                    return None
                content = file.read()
            digest, program = content[:_DIGEST], content[_DIGEST:]
            # A single wrong bit could end the process.
            if hashlib.sha256(program).digest() == digest:
                return Found(*pickle.loads(program))
        return None

    def save(self, name: str, args: Any, results: Any, program: Any) -> None:
        """Keeps a program, if it can be and there is room; see `find`."""
        options = jax.config.values
        if options["jax_enable_compilation_cache"] and options["jax_compilation_cache_dir"]:
            return  # what comes out of JAX's cache lacks its kernels when it is serialised again
        path = self._file(name, args)
        unfinished = path.with_suffix(f".{os.getpid()}")
        try:
            number = len(jax.tree.leaves(program.input_shardings)[0].device_set)
            parts = serialize_executable.serialize(program)
            content = pickle.dumps((results, number, parts))
            unfinished.touch(mode=0o600)  # whatever the umask, see `find`
            unfinished.write_bytes(hashlib.sha256(content).digest() + content)
            unfinished.replace(path)
        except Exception:
            # A run must not end because the next one will be slower.
            unfinished.unlink(missing_ok=True)

    def _file(self, name: str, args: Any) -> Path:
        """Where a program is kept."""
        shapes = jax.eval_shape(lambda args: args, args)
        digest = hashlib.sha256(repr(shapes).encode()).hexdigest()[:16]
        return self.path / f"{name}-{digest}.pickle"


@dataclasses.dataclass(frozen=True)
class Found:
    """A program that was kept.

    Attributes:
      results: shapes of its results.
      number: of devices that it runs on.
      parts: what JAX made of it.
    """

    results: Any
    number: int
    parts: tuple[bytes, Any, Any]

    def load(self) -> Callable[..., Any] | None:
        """The program itself; None if JAX cannot load it."""
        # As in `Kept.find`; JAX raises whatever its parts raise.
        with contextlib.suppress(Exception):
            # Only lowering a call of LAPACK binds its functions; a kept program would call nothing.
            jax.jit(jnp.linalg.cholesky).lower(jax.ShapeDtypeStruct((1, 1), jnp.float32))
            there = jax.devices()[: self.number]
            return serialize_executable.deserialize_and_load(*self.parts, execution_devices=there)
        return None


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
        **shardings: Any,
    ) -> Any:
        """Begins to load a function that was kept, or traces it and begins to compile it.

        Args:
          function: what to compile.
          *args: arguments or their shapes, for example the result of another program's `compile`.
          runs_long: see `devices.compiler_options`.
          workers: who shares the rows of the arguments; their number divides the rows.
          whole: positions of arguments that every worker gets as they are.
          **shardings: `in_shardings` and `out_shardings` of `jax.jit`, for a function that splits
            its work itself.

        Returns:
          Shapes and dtypes of the results, as a pytree.
        """
        self._compiler.check_open()
        begin = time.perf_counter()
        self._workers, self._whole = workers, whole
        function = devices.spread(function, workers.mesh, whole)
        args = devices.part(args, 0, workers.threads, whole)
        split = jax.tree.leaves(shardings)
        number = split[0].num_devices if split else 1 if workers.mesh is None else workers.number
        kept, name = self._compiler.kept, f"{self._stage}-{self._name}-{number}"

        def lower() -> tuple[jax.stages.Lowered, Any]:
            traced = jax.jit(function, **shardings).trace(*args)
            return traced.lower(), traced.out_info

        found = None if kept is None else kept.find(name, args)
        if found is None:
            lowered, results = lower()
        else:
            lowered, results = None, found.results
        self._monitor.add(self._stage, "compile_s", time.perf_counter() - begin)

        def compile_lowered() -> None:
            begin = time.perf_counter()
            try:
                compiled = None if found is None else found.load()
                is_new = compiled is None
                if compiled is None:
                    options = devices.compiler_options(runs_long=runs_long)
                    compiled = (lowered or lower()[0]).compile(compiler_options=options)
            except Exception as error:
                self.fail(error)
                return
            self._monitor.add(self._stage, "compile_s", time.perf_counter() - begin)
            with contextlib.suppress(InvalidStateError):  # it has failed for another reason
                self._compiled.set_result(compiled)
            if kept is not None and is_new:
                kept.save(name, args, results, compiled)

        self._compiler.submit(compile_lowered)
        return devices.of_all_parts(results, workers.threads)

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

        def run(i: int) -> Any:
            return jax.block_until_ready(compiled(*devices.part(args, i, number, self._whole)))

        output = devices.joined(devices.side_by_side(run, number))
        self._monitor.add(self._stage, "run_s", time.perf_counter() - begin)
        return output


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
