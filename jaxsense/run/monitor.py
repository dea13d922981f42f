"""What a stage tells the outside while it runs: time, progress, metrics, and bad ends."""

import threading
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

Listener = Callable[[str, int, int, dict[str, float]], None]
"""`(stage, done, total, metrics)`, called from the host between two chunks of work."""


class StageError(RuntimeError):
    """A training that cannot go on: names the stage and the step."""


class Stopped(Exception):  # noqa: N818 (nothing is wrong)
    """A run that was asked to stop; what it trained until then has been saved."""


def is_finite(values: Any) -> bool:
    """Whether all real numbers in arrays, or pytrees of them, are finite."""
    leaves = [x for x in jax.tree.leaves(values) if jnp.issubdtype(x.dtype, jnp.inexact)]
    return all(np.isfinite(leaf).all() for leaf in leaves)


class Monitor:
    """What the stages of a run have in common: a clock and a listener.

    Attributes:
      seconds: for each stage, `{"compile_s": ..., "run_s": ...}` so far.
    """

    def __init__(
        self,
        listener: Listener = lambda stage, done, total, metrics: None,
        warn: Callable[[str], None] = lambda text: None,
    ):
        """Begins a run.

        Args:
          listener: is told of progress.
          warn: takes a line about something that went wrong and does not end the run.
        """
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self.warn = warn
        self.begin(listener)

    def begin(self, listener: Listener) -> None:
        """Begins another run, with other times and another listener."""
        self.seconds: dict[str, dict[str, float]] = {}
        self._failure: StageError | None = None
        self._one_listener = listener

    def beside(self, listener: Listener) -> "Monitor":
        """The monitor of another run, side by side with this one: it stops with it."""
        other = Monitor(listener, self.warn)
        other._stop = self._stop
        return other

    def _listener(self, stage: str, done: int, total: int, metrics: dict[str, float]) -> None:
        """Tells the listener; stages may run side by side."""
        with self._lock:
            self._one_listener(stage, done, total, metrics)

    def stop(self) -> None:
        """Asks the stages to save what they have and to stop."""
        self._stop.set()

    def fail(self, failure: StageError) -> None:
        """Ends what goes on side by side with a stage that has failed."""
        self._failure = failure

    @property
    def is_stopping(self) -> bool:
        """Whether the stages are to stop."""
        return self._stop.is_set() or self._failure is not None

    def check_stop(self) -> None:
        """Raises `Stopped` if the stages are to stop; the failure, if another one has failed."""
        if self._failure is not None:
            raise self._failure
        if self.is_stopping:
            raise Stopped

    def announce(self, stage: str) -> None:
        """Reports that a stage is being compiled."""
        self._listener(stage, 0, 0, {})

    def progress(self, stage: str, done: int, total: int) -> None:
        """Reports progress of a stage that has no loss."""
        self._listener(stage, done, total, {})

    def check_finite(self, stage: str, name: str, values: Any) -> None:
        """Raises a `StageError` that names the stage and the values, if one is not finite.

        Args:
          stage: its name.
          name: of the values, for example "parameters at step 20 of 40".
          values: arrays, or pytrees of them.
        """
        if not is_finite(values):
            raise StageError(f"{stage}: {name} are not finite")

    def report(
        self,
        stage: str,
        done: int,
        total: int,
        losses: np.ndarray,
        params: Any = (),
        **metrics: float,
    ) -> None:
        """Reports a chunk of training.

        Args:
          stage: its name.
          done: steps so far, those of the chunk included.
          total: steps of the whole stage.
          losses: `[steps]` of the chunk; their mean is reported.
          params: what was trained, as it is after the chunk.
          **metrics: what else to report.

        Raises:
          StageError: if a loss or a parameter is not finite; names the step.
        """
        bad = np.flatnonzero(~np.isfinite(losses))
        if len(bad):
            step = done - len(losses) + bad[0] + 1
            raise StageError(f"{stage}: loss = {losses[bad[0]]} at step {step} of {total}")
        self.check_finite(stage, f"parameters after step {done} of {total}", params)
        self._listener(stage, done, total, {"loss": float(np.mean(losses)), **metrics})

    def add(self, stage: str, kind: str, seconds: float) -> None:
        """Adds to the time of a stage; `kind` is "compile_s" or "run_s"."""
        with self._lock:
            entry = self.seconds.setdefault(stage, {"compile_s": 0.0, "run_s": 0.0})
            entry[kind] += seconds
