"""Trainings in chunks, between which the host reports, saves, and stops if it is asked to."""

import time
from collections.abc import Callable
from typing import Any

from jaxsense.checkpoints import Checkpoints, Curves, Unfinished
from jaxsense.monitor import Monitor, StageError

_SAVE_PERIOD = 60.0  # s


def run_chunks(
    stage: str,
    state: Any,
    number: int,
    run: Callable[[int, Any], tuple[Any, Curves]],
    monitor: Monitor,
    checkpoints: Checkpoints,
) -> tuple[Any, Curves]:
    """Runs a training, from where it was when it was saved last.

    Args:
      stage: its name.
      state: what it starts from.
      number: of chunks.
      run: `(chunk, state) -> (state, figures)`; the same for the same chunk and state.
      monitor: knows whether to stop.
      checkpoints: where the training is saved once a minute, and when it stops.

    Returns:
      The last state and the figures of all chunks.

    Raises:
      Stopped: if the run is to stop before the training is over; it has been saved.
      StageError: from `run`; what was there before the chunk has been saved, and trainings side by
        side with this one end with the same error after their chunk.
    """
    done, curves = 0, Curves()
    found = checkpoints.load_unfinished(stage, state)
    if found is not None:
        done, state, curves = found
    saved = time.monotonic()
    for chunk in range(done, number):
        try:
            after, figures = run(chunk, state)
        except StageError as error:
            monitor.fail(error)
            try:
                checkpoints.save_unfinished(stage, Unfinished(chunk, state, curves))
            except OSError as lost:
                raise StageError(f"{error}; what was sound cannot be saved ({lost})") from error
            raise
        state = after
        for name, values in figures.items():
            curves.setdefault(name, []).extend(values)
        is_late = time.monotonic() - saved > _SAVE_PERIOD
        if is_late or monitor.is_stopping:
            checkpoints.save_unfinished(stage, Unfinished(chunk + 1, state, curves))
            saved = time.monotonic()
        if chunk + 1 < number:
            monitor.check_stop()
    return state, curves
