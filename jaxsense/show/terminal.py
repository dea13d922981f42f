"""Shows the progress of a program: on a terminal, as lines, or as event files for TensorBoard."""

import time
from collections.abc import Callable, Sequence
from pathlib import Path

import rich.console
from rich import progress
from rich.table import Column

from jaxsense.core import inside
from jaxsense.run.output import say

_LINE_PERIOD = 5.0  # s


class Display:
    """Progress of a run: a live bar for each stage, or plain lines without a terminal."""

    def __init__(
        self,
        records: Sequence[Callable[..., None]] = (),
        quiet: bool = False,
        console: rich.console.Console | None = None,
    ):
        """Shows progress on a console; `records` receive the metrics of every report."""
        console = console or rich.console.Console()
        self._records, self._quiet, self._is_live = records, quiet, console.is_terminal
        self._tasks: dict[str, progress.TaskID] = {}
        self._last: dict[str, float] = {}
        self._begin = time.perf_counter()
        columns = (
            progress.TextColumn("{task.description}", table_column=Column(min_width=15)),
            progress.BarColumn(10),
            progress.MofNCompleteColumn(),
            progress.TimeRemainingColumn(),
            progress.TextColumn("{task.fields[metrics]}"),
        )
        is_shown = self._is_live and not quiet
        self._progress = progress.Progress(*columns, console=console, disable=not is_shown)

    def __enter__(self) -> "Display":
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def show(self, stage: str, done: int, total: int, metrics: dict[str, float]) -> None:
        """Shows a report of a `Monitor`.

        Args:
          stage: its name.
          done: its steps so far.
          total: all its steps; 0 means that it compiles.
          metrics: to show and to record.
        """
        if total:
            for record in self._records:
                record(stage=stage, step=done, **metrics)
        if self._quiet:
            return
        text = "  ".join(f"{name} {value:.4g}" for name, value in metrics.items())
        if stage not in self._tasks:
            self._tasks[stage] = self._progress.add_task(stage, total=None, metrics="compiling")
        if total:
            number = self._tasks[stage]
            self._progress.update(number, completed=done, total=total, metrics=text)
        for other in self._progress.tasks:
            # Stages without a total never report that they end.
            is_waiting = other.total is None and other.description != stage
            self._progress.update(other.id, visible=not is_waiting)
        if not self._is_live:
            self._show_line(stage, done, total, text)

    def _show_line(self, stage: str, done: int, total: int, text: str) -> None:
        """Prints a line for each stage every few seconds, always its first and last."""
        now, is_first = time.perf_counter(), stage not in self._last
        is_over = total and done >= total
        if not (is_first or is_over or now - self._last[stage] >= _LINE_PERIOD):
            return
        self._last[stage] = now if total else now - _LINE_PERIOD
        left = self._progress.tasks[self._tasks[stage]].time_remaining
        state = f"{done} of {total}" if total else "compiling"
        state += f", {left:.0f} s left" if left else ""
        say(f"{now - self._begin:6.1f} s  {stage}: {state}  {text}".rstrip())


def tensorboard(path: Path) -> Callable[..., None]:
    """Returns a function that writes reported metrics to event files in a directory of a run."""
    from tensorboardX import SummaryWriter  # noqa: PLC0415 (an optional dependency)

    writer = SummaryWriter(str(inside.place(path, path.parent)))

    def write(*, stage: str, step: int, **metrics: float) -> None:
        for name, value in metrics.items():
            writer.add_scalar(f"{stage}/{name}", value, step)
        writer.flush()

    return write
