"""Graceful stop of a run on Ctrl-C, or on SIGTERM at the end of a job's time."""

import contextlib
import os
import signal
from collections.abc import Callable, Iterator
from types import FrameType

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


@contextlib.contextmanager
def on_interrupt(stop: Callable[[], None]) -> Iterator[None]:
    """Calls `stop` at the first Ctrl-C or SIGTERM; the second one aborts the process.

    Enter it in the main thread, where Python handles signals.
    """
    # Signals that the parent process made this one ignore stay ignored.
    before = {
        number: handler
        for number in _SIGNALS
        if (handler := signal.getsignal(number)) is not signal.SIG_IGN
    }

    def end(number: int, frame: FrameType | None) -> None:
        # Any other exit would wait for threads that compile or save.
        with contextlib.suppress(OSError):
            os.write(2, b"Aborted; earlier checkpoints are intact.\n")
        os._exit(128 + number)

    def handle(number: int, frame: FrameType | None) -> None:
        for each in before:
            signal.signal(each, end)
        stop()

    for number in before:
        signal.signal(number, handle)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
