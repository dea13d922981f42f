"""What a stage tells the outside while it runs: time, progress, figures, and bad ends."""

import os
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import jax
import numpy as np

from jaxsense import devices

Listener = Callable[[str, int, int, dict[str, float]], None]
"""`(stage, done, total, figures)`, called from the host between two chunks of work."""

_COMPILERS = min(os.cpu_count() or 1, 8)


class StageError(RuntimeError):
    """A training that cannot go on: names the stage and the step."""


class Program:
    """A function of a stage that is compiled in the background; a call waits for that and runs it.

    It may be called, from another thread, before it is known what it does.
    """

    def __init__(self, monitor: "Monitor", stage: str):
        self._monitor, self._stage = monitor, stage
        self._compiled: Future[Callable[..., Any]] = Future()

    def compile(
        self,
        function: Callable[..., Any],
        *args: Any,
        donate: tuple[int, ...] = (),
        runs_long: bool = False,
        **shardings: Any,
    ) -> Any:
        """Traces a function and begins to compile it.

        Args:
          function: what to compile.
          *args: arguments or their shapes, for example the result of another program's `compile`.
          donate: positions of arguments whose memory the program may use for its results.
          runs_long: see `devices.compiler_options`.
          **shardings: `in_shardings` and `out_shardings` of `jax.jit`.

        Returns:
          Shapes and dtypes of the results, as a pytree.
        """
        begin = time.perf_counter()
        traced = jax.jit(function, donate_argnums=donate, **shardings).trace(*args)
        lowered = traced.lower()
        self._monitor.add(self._stage, "compile_s", time.perf_counter() - begin)

        def compile_lowered() -> None:
            begin = time.perf_counter()
            try:
                options = devices.compiler_options(runs_long=runs_long)
                compiled = lowered.compile(compiler_options=options)
            except Exception as error:
                self.fail(error)
            else:
                self._monitor.add(self._stage, "compile_s", time.perf_counter() - begin)
                self._compiled.set_result(compiled)

        self._monitor.compiler.submit(compile_lowered)
        return traced.out_info

    def fail(self, error: BaseException) -> None:
        """Raises an error from all calls, unless the program is there already."""
        if not self._compiled.done():
            self._compiled.set_exception(error)

    def wait(self) -> Callable[..., Any]:
        """Waits until the program is compiled, and gives it."""
        if not self._compiled.done():
            self._monitor.announce(self._stage)
        return self._compiled.result()

    def __call__(self, *args: Any) -> Any:
        """Runs the program until its results are there."""
        compiled = self.wait()
        begin = time.perf_counter()
        output = jax.block_until_ready(compiled(*args))
        self._monitor.add(self._stage, "run_s", time.perf_counter() - begin)
        return output


class Monitor:
    """What the programs of a run have in common: compilers, a clock and a listener.

    Attributes:
      seconds: for each stage, `{"compile_s": ..., "run_s": ...}` so far.
      compiler: threads that compile.
    """

    def __init__(self, listener: Listener = lambda stage, done, total, figures: None):
        self.seconds: dict[str, dict[str, float]] = {}
        self._lock = threading.Lock()
        self._listener = self._one_at_a_time(listener)
        self.compiler = ThreadPoolExecutor(_COMPILERS)

    def _one_at_a_time(self, listener: Listener) -> Listener:
        """Stages may run side by side."""

        def listen(stage: str, done: int, total: int, figures: dict[str, float]) -> None:
            with self._lock:
                listener(stage, done, total, figures)

        return listen

    def close(self) -> None:
        """Gives up what is still waiting to be compiled."""
        self.compiler.shutdown(wait=False, cancel_futures=True)

    def announce(self, stage: str) -> None:
        """Reports that a stage is being compiled."""
        self._listener(stage, 0, 0, {})

    def progress(self, stage: str, done: int, total: int) -> None:
        """Reports progress of a stage that has no loss."""
        self._listener(stage, done, total, {})

    def check_finite(self, stage: str, params: Any) -> None:
        """Raises a `StageError` if a trained parameter is not finite."""
        if not all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(params)):
            raise StageError(f"{stage}: parameters are not finite after the last step")

    def report(
        self, stage: str, done: int, total: int, losses: np.ndarray, **figures: float
    ) -> None:
        """Reports a chunk of training.

        Args:
          stage: its name.
          done: steps so far, those of the chunk included.
          total: steps of the whole stage.
          losses: `[steps]` of the chunk; their mean is reported.
          **figures: what else to report.

        Raises:
          StageError: if a loss is not finite; names the first such step.
        """
        bad = np.flatnonzero(~np.isfinite(losses))
        if len(bad):
            step = done - len(losses) + bad[0] + 1
            raise StageError(f"{stage}: loss = {losses[bad[0]]} at step {step} of {total}")
        self._listener(stage, done, total, {"loss": float(np.mean(losses)), **figures})

    def add(self, stage: str, kind: str, seconds: float) -> None:
        """Adds to the time of a stage; `kind` is "compile_s" or "run_s"."""
        with self._lock:
            entry = self.seconds.setdefault(stage, {"compile_s": 0.0, "run_s": 0.0})
            entry[kind] += seconds
