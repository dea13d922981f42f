"""What a stage tells the outside while it runs: time, progress, figures, and bad ends."""

import threading
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

Listener = Callable[[str, int, int, dict[str, float]], None]
"""`(stage, done, total, figures)`, called from the host between two chunks of work."""


class StageError(RuntimeError):
    """A training that cannot go on: names the stage and the step."""


class Stopped(Exception):  # noqa: N818 (nothing is wrong)
    """A run that was asked to stop; what it trained until then has been saved."""


class Monitor:
    """What the stages of a run have in common: a clock and a listener.

    Attributes:
      seconds: for each stage, `{"compile_s": ..., "run_s": ...}` so far.
    """

    def __init__(self, listener: Listener = lambda stage, done, total, figures: None):
        self.seconds: dict[str, dict[str, float]] = {}
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._listener = self._one_at_a_time(listener)

    def _one_at_a_time(self, listener: Listener) -> Listener:
        """Stages may run side by side."""

        def listen(stage: str, done: int, total: int, figures: dict[str, float]) -> None:
            with self._lock:
                listener(stage, done, total, figures)

        return listen

    def stop(self) -> None:
        """Asks the stages to save what they have and to stop."""
        self._stop.set()

    @property
    def is_stopping(self) -> bool:
        """Whether the stages are to stop."""
        return self._stop.is_set()

    def check_stop(self) -> None:
        """Raises `Stopped` if the stages are to stop."""
        if self.is_stopping:
            raise Stopped

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
