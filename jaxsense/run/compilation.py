"""Compiles programs in the background."""

from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager
from typing import Literal

import jax
import numpy as np
from jax.sharding import Mesh
from jaxtyping import PyTree

from jaxsense.config import ConfigError
from jaxsense.run import devices
from jaxsense.run.devices import Workers
from jaxsense.run.kept import Function, Kept, shapes_of, trace
from jaxsense.run.monitor import Monitor

_ROWS_AT_ONCE = 512  # of each thread; their results take up little memory besides those of all


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
