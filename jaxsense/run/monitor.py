"""Reports of running stages: time, progress, metrics and failures."""

import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, wait
from typing import Literal, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from jaxsense.summary.blocks import StageTiming, Timing

T = TypeVar("T")

Listener = Callable[[str, int, int, dict[str, float]], None]
"""`(stage, done, total, metrics)`, called from the host between two chunks of work."""


class StageError(RuntimeError):
    """A stage that cannot continue; the message names the stage and the step."""


class Stopped(Exception):  # noqa: N818 (nothing is wrong)
    """The run was asked to stop; all its training is saved."""


def is_finite(values: PyTree) -> bool:
    """Whether all floats in a pytree of arrays are finite."""
    is_float = lambda x: jnp.issubdtype(jnp.result_type(x), jnp.inexact)  # noqa: E731
    return all(np.isfinite(x).all() for x in jax.tree.leaves(values) if is_float(x))


class Monitor:
    """The stopwatch and the listener that the stages of a run share, in all threads."""

    def __init__(
        self,
        listener: Listener = lambda stage, done, total, metrics: None,
        warn: Callable[[str], None] = lambda text: None,
    ):
        """Begins a run.

        Args:
          listener: receives progress.
          warn: receives a line about a failure that does not end the run.
        """
        self.warn, self._failure = warn, None
        self._lock, self._stop = threading.Lock(), threading.Event()
        self.begin(listener)
        self.restart()

    def begin(self, listener: Listener) -> None:
        """Begins another run with the same programs, also if a stage of the last one failed."""
        self._listener = listener
        if isinstance(self._failure, StageError):
            self._failure = None

    def restart(self) -> None:
        """Starts the stopwatch again for another run."""
        self._begin, self._stages = time.perf_counter(), dict[str, StageTiming]()

    @contextlib.contextmanager
    def measure(self, kind: Literal["compile_s", "run_s"], stage: str) -> Iterator[None]:
        """Adds the seconds of a block to those of a stage."""
        begin = time.perf_counter()
        yield
        seconds = time.perf_counter() - begin
        with self._lock:
            self._stages.setdefault(stage, {"compile_s": 0.0, "run_s": 0.0})[kind] += seconds

    def timing(self) -> Timing:
        """The time since the start."""
        with self._lock:
            stages = {name: each.copy() for name, each in self._stages.items()}
        return {"total_s": time.perf_counter() - self._begin, "stages": stages}

    def stop(self) -> None:
        """Asks the stages to save their training and stop."""
        self._stop.set()

    def fail(self, failure: BaseException) -> None:
        """Stops everything that runs or waits beside what has failed."""
        if self._failure is None or isinstance(self._failure, StageError):
            self._failure = failure  # which another run may not forget

    @property
    def is_stopping(self) -> bool:
        """Whether the stages must stop."""
        return self._stop.is_set() or self._failure is not None

    def check_stop(self) -> None:
        """Raises the error of a failed stage, or `Stopped` if the run was asked to stop."""
        if self._failure is not None:
            raise self._failure
        if self._stop.is_set():
            raise Stopped

    def wait_for(self, future: Future[T]) -> T:
        """The result of a future of another thread; raises as `check_stop` does meanwhile."""
        while not future.done():
            self.check_stop()
            wait((future,), timeout=0.2)
        return future.result()

    def progress(self, stage: str, done: int, total: int, **metrics: float) -> None:
        """Reports how many units of work of a stage are done, of how many; of none, it compiles.

        One stage reports at a time.
        """
        with self._lock:
            self._listener(stage, done, total, metrics)
