"""Programs that are compiled in the background, and kept for later runs."""

import contextlib
import dataclasses
import hashlib
import importlib.metadata
import os
import pickle
import platform
import shutil
import time
from collections.abc import Callable
from concurrent.futures import Future, InvalidStateError, ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from jax.experimental import serialize_executable
from jax.sharding import Mesh

from jaxsense import devices
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
          OSError: if the directory cannot be made.
        """
        text = repr((settings, _SOURCE, _surroundings())).encode()
        self.path = directory / "programs" / hashlib.sha256(text).hexdigest()[:32]
        self.path.mkdir(parents=True, exist_ok=True)
        self.path.touch()
        # Another run may forget some at the same time.
        with contextlib.suppress(FileNotFoundError):
            others = sorted(self.path.parent.iterdir(), key=lambda path: path.stat().st_mtime)
            for path in others[:-_MOST_KEPT]:
                shutil.rmtree(path, ignore_errors=True)

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
            content = self._file(name, args).read_bytes()
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

    def __enter__(self) -> "Compiler":
        return self

    def __exit__(self, *error: Any) -> None:
        """Gives up what is still waiting, or else the process would go on with it."""
        self._threads.shutdown(wait=False, cancel_futures=True)

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

    def compile(
        self,
        function: Callable[..., Any],
        *args: Any,
        donate: tuple[int, ...] = (),
        runs_long: bool = False,
        mesh: Mesh | None = None,
        **shardings: Any,
    ) -> Any:
        """Begins to load a function that was kept, or traces it and begins to compile it.

        Args:
          function: what to compile.
          *args: arguments or their shapes, for example the result of another program's `compile`.
          donate: positions of arguments whose memory the program may use for its results.
          runs_long: see `devices.compiler_options`.
          mesh: devices that the function splits its work over, if it does.
          **shardings: `in_shardings` and `out_shardings` of `jax.jit`.

        Returns:
          Shapes and dtypes of the results, as a pytree.
        """
        begin = time.perf_counter()
        number = 1 if mesh is None else mesh.size
        kept, name = self._compiler.kept, f"{self._stage}-{self._name}-{number}"

        def lower() -> tuple[jax.stages.Lowered, Any]:
            traced = jax.jit(function, donate_argnums=donate, **shardings).trace(*args)
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
        return results

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
        begin = time.perf_counter()
        output = jax.block_until_ready(compiled(*args))
        self._monitor.add(self._stage, "run_s", time.perf_counter() - begin)
        return output


def _surroundings() -> list[Any]:
    """What else tracing and compiling depend on: versions, options, devices and processor."""
    features = set()
    with contextlib.suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text().splitlines()
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
