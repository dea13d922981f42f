"""What a stage tells the outside while it runs: time, progress, figures, and bad ends."""

import time
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

Listener = Callable[[str, int, int, dict[str, float]], None]
"""`(stage, done, total, figures)`, called from the host between two chunks of work."""


class StageError(RuntimeError):
    """A training that cannot go on: names the stage and the step."""


class Monitor:
    """Runs jitted functions, with the time of compiling and of running apart.

    Attributes:
      seconds: for each stage, `{"compile_s": ..., "run_s": ...}` so far.
    """

    def __init__(self, listener: Listener = lambda stage, done, total, figures: None):
        self.seconds: dict[str, dict[str, float]] = {}
        self._listener = listener

    def compile(
        self, stage: str, function: Callable[..., Any], *args: Any, announce: bool = True
    ) -> Callable[..., Any]:
        """Compiles a function for arguments of these shapes; the result counts its own run time.

        Without `announce` the listener is not told, as for a compilation in the background.
        """
        if announce:
            self._listener(stage, 0, 0, {})
        begin = time.perf_counter()
        compiled = jax.jit(function).lower(*args).compile()
        self._add(stage, "compile_s", time.perf_counter() - begin)

        def run(*args: Any) -> Any:
            begin = time.perf_counter()
            output = jax.block_until_ready(compiled(*args))
            self._add(stage, "run_s", time.perf_counter() - begin)
            return output

        return run

    def run(self, stage: str, function: Callable[..., Any], *args: Any) -> Any:
        """Compiles a function and runs it once; reports the stage as done."""
        output = self.compile(stage, function, *args)(*args)
        self._listener(stage, 1, 1, {})
        return output

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

    def _add(self, stage: str, kind: str, seconds: float) -> None:
        entry = self.seconds.setdefault(stage, {"compile_s": 0.0, "run_s": 0.0})
        entry[kind] += seconds
