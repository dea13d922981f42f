"""Records when a run does what."""

import contextlib
import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TypeAlias

from jaxsense.summary.profile import Kind, Span

Recorder: TypeAlias = Callable[[Kind], AbstractContextManager[None]]
"""Records what is done for a program within a block, see `Clock.record`."""


class Clock:
    """The clock of a run, passed to whatever takes time. Spans of one thread must not overlap.

    Attributes:
      begin: when the run began, in seconds since the process started.
    """

    def __init__(self, start: float | None = None):
        """Starts with no spans.

        Args:
          start: value of `time.perf_counter` when the process started; now by default.
        """
        self._start = time.perf_counter() if start is None else start
        self._spans: list[Span] = []
        self.begin = 0.0

    @property
    def now(self) -> float:
        """Seconds since the process started."""
        return time.perf_counter() - self._start

    @property
    def spans(self) -> list[Span]:
        """What all threads have done so far since `begin`."""
        return self._spans.copy()

    def restart(self) -> None:
        """Begins another run of the same process, and forgets the spans of the one before."""
        self._spans, self.begin = [], self.now

    def add(self, kind: Kind, stage: str = "", program: str = "", *, since: float) -> None:
        """Records what the calling thread has done.

        Args:
          kind: what it did.
          stage: for which stage, if any.
          program: which of its programs, if any.
          since: when it began, in seconds since the process started.
        """
        thread = threading.current_thread().name
        self._spans.append(Span(kind, stage, program, thread, since, self.now))

    def add_rest(self, kind: Kind) -> None:
        """Records what the calling thread has done since its last span, or else since `begin`."""
        thread = threading.current_thread().name
        ends = (span.end_s for span in self.spans if span.thread == thread)
        self.add(kind, since=max(ends, default=self.begin))

    @contextlib.contextmanager
    def record(self, kind: Kind, stage: str = "", program: str = "") -> Iterator[None]:
        """Records what the calling thread does within a block; see `add`."""
        since = self.now
        try:
            yield
        finally:
            self.add(kind, stage, program, since=since)


def process_start() -> float:
    """Value of `time.perf_counter` when this process started; now, unless the system is Linux."""
    now = time.perf_counter()
    with contextlib.suppress(OSError, ValueError, IndexError):
        # Field 22, see proc(5): clock ticks since the machine was started.
        fields = Path("/proc/self/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
        started = int(fields[19]) / os.sysconf("SC_CLK_TCK")
        return now - max(time.clock_gettime(time.CLOCK_BOOTTIME) - started, 0.0)
    return now
