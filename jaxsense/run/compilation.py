"""Compiles programs in the background."""

import contextlib
from concurrent.futures import CancelledError, Future, InvalidStateError, ThreadPoolExecutor
from contextlib import AbstractContextManager
from typing import Literal

import jax
import jax.numpy as jnp
from jaxtyping import PyTree

from jaxsense.run import devices
from jaxsense.run.devices import ALONE, Workers
from jaxsense.run.kept import Function, Kept, Traced, shapes_of, trace
from jaxsense.run.monitor import Monitor


class Compiler:
    """Compiles the programs of a run in its own threads, until the end of the block."""

    def __init__(self, monitor: Monitor, kept: Kept | None = None):
        self.monitor, self.kept, self.is_closed = monitor, kept, False
        self.threads = ThreadPoolExecutor(devices.NUM_THREADS, "compile")

    def __enter__(self) -> "Compiler":
        return self

    def __exit__(self, *_: object) -> None:
        """Cancels pending work, which would keep the process alive."""
        self.is_closed = True
        self.threads.shutdown(wait=False, cancel_futures=True)


class Program:
    """A function of a stage, compiled in the background.

    May be called before `compile`, from another thread; the call blocks until it is compiled.
    """

    def __init__(self, compiler: Compiler, stage: str, name: str):
        self._compiler, self._monitor = compiler, compiler.monitor
        self._stage, self._name = stage, name
        self._compiled: Future[Function] = Future()
        self._workers, self._whole, self._results = ALONE, (), None
        self._rows: int | None = None  # of results, where the last are left out

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
          *args: arguments or their shapes.
          workers: share the rows of the arguments.
          whole: positions of arguments that every worker gets undivided.
          **options: see `devices.compiler_options`.

        Returns:
          Shapes of the results.
        """
        if self._compiler.is_closed:
            raise CancelledError
        self._workers, self._whole = workers, whole
        with self._measure("compile_s"):
            lowered, results = self._lower(function, self._padded(args))
        self._results = devices.of_all_parts(results, workers.shares)

        def compile_lowered() -> None:
            if self._compiled.done():  # failed or released
                return
            try:
                with self._measure("compile_s"):
                    supported = devices.compiler_options(**options)
                    compiled = lowered.compile(compiler_options=supported)
            except Exception as error:
                self.fail(error)
                return
            with contextlib.suppress(InvalidStateError):  # `fail` was called before
                self._compiled.set_result(compiled)
            devices.give_back_freed()

        self._compiler.threads.submit(compile_lowered)
        if (rows := self._rows) is None:
            return self._results
        return jax.tree.map(lambda x: x.update(shape=(rows, *x.shape[1:])), self._results)

    def _measure(self, kind: Literal["compile_s", "run_s"]) -> AbstractContextManager[None]:
        """Adds the seconds of a block to those of the stage."""
        return self._monitor.stopwatch.measure(kind, self._stage)

    def _padded(self, args: tuple[PyTree, ...]) -> tuple[PyTree, ...]:
        """Arguments of which all workers get equally many rows, the first of them repeated."""
        number = self._workers.shares
        if number == 1:
            return args

        def pad(x: jax.Array | jax.ShapeDtypeStruct) -> jax.Array | jax.ShapeDtypeStruct:
            given = x.shape[0]
            if not (missing := -given % number):
                return x
            self._rows = given
            if isinstance(x, jax.ShapeDtypeStruct):
                return x.update(shape=(given + missing, *x.shape[1:]))
            return x[jnp.arange(given + missing) % given]

        return tuple(x if i in self._whole else jax.tree.map(pad, x) for i, x in enumerate(args))

    def _lower(
        self, function: Function, args: tuple[PyTree, ...]
    ) -> tuple[jax.stages.Lowered, PyTree]:
        """A function ready to be compiled, and the shapes of a share's results; see `compile`."""
        workers, whole = self._workers, self._whole
        call, share = (
            devices.part(args, 0, number, whole) for number in (workers.parts, workers.shares)
        )
        found = self._found_or_traced(function, share)
        if found is not None:
            spread = devices.spread(found.__call__, workers.mesh, whole)
            jitted = jax.jit(spread, in_shardings=self._places(len(args)))
            return jitted.lower(*shapes_of(call)), found.results
        traced = jax.jit(function).trace(*call)
        return traced.lower(), traced.out_info

    def _found_or_traced(self, function: Function, share: tuple[PyTree, ...]) -> Traced | None:
        """The program apart from what calls it, which only caches and meshes need."""
        if (kept := self._compiler.kept) is not None:
            found = kept.find_or_trace(f"{self._stage}-{self._name}", function, share)
            if found is not None:
                return found
        if self._workers.mesh is None:
            return None
        try:
            return trace(function, share)
        except NotImplementedError as error:
            reason = f"{self._stage}: cannot be split over several devices; use one ({error})"
            raise NotImplementedError(reason) from error

    def _places(self, number: int) -> tuple[jax.sharding.NamedSharding, ...] | None:
        """Where each of a number of arguments lies on a mesh; None without one."""
        mesh = self._workers.mesh
        return None if mesh is None else devices.shardings(mesh, number, self._whole)

    def _put(self, args: tuple[PyTree, ...]) -> tuple[PyTree, ...]:
        """Arguments where a mesh needs them."""
        places = self._places(len(args))
        if places is None:
            return args
        put = devices.put if jax.process_count() > 1 else jax.device_put
        return put(args, places)

    def fail(self, error: BaseException) -> None:
        """Makes all calls raise an error, unless the program is compiled already."""
        with contextlib.suppress(InvalidStateError):
            self._compiled.set_exception(error)

    def release(self) -> None:
        """Lets go of the compiled program, which holds tens of MiB; nobody may call it again."""
        released = Future[Function]()
        released.set_exception(RuntimeError(f"{self._name} of {self._stage} was released"))
        self._compiled = released

    def wait(self) -> Function:
        """Blocks until the program is compiled; raises what `Monitor.check_stop` does."""
        if not self._compiled.done():
            self._monitor.announce(self._stage)
            return self._monitor.wait_for(self._compiled)
        return self._compiled.result()

    def run(self, *args: PyTree) -> PyTree[jax.Array]:
        """Runs a program that threads do not share, and leaves its results on the devices."""
        compiled = self.wait()
        # JAX itself places what one process runs, and in missions most of it lies there already.
        return compiled(*(args if jax.process_count() == 1 else self._put(args)))

    def __call__(self, *args: PyTree) -> PyTree:
        """Runs the program, and blocks until its results are ready, on the host if it is split."""
        compiled = self.wait()
        number = self._workers.parts

        def run(i: int) -> PyTree:
            return jax.block_until_ready(compiled(*devices.part(args, i, number, self._whole)))

        with self._measure("run_s"):
            args = self._put(self._padded(args))
            output = devices.joined(run, number, self._workers.threads, self._results)
            # Other programs run on one device.
            output = output if self._workers.mesh is None else devices.fetched(output)
            return output if self._rows is None else jax.tree.map(lambda x: x[: self._rows], output)
