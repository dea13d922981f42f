"""Shows the progress of a program."""

import io
import time
from collections.abc import Callable, Sequence

import rich.box
import rich.console
import rich.progress
import rich.table
import rich.text
from rich.table import Column

from jaxsense.run.output import say
from jaxsense.show.tables import Table

_LINE_PERIOD = 5.0  # s
_ENDLESS = 10_000  # columns of a file or a pipe, where nothing is cut
_WIDE = 110  # columns of a terminal, enough for a bar


class Display:
    """Progress of a run: a live bar for each stage, or plain lines without a terminal."""

    def __init__(
        self,
        console: rich.console.Console,
        records: Sequence[Callable[..., None]] = (),
        quiet: bool = False,
    ):
        """Shows progress on a console.

        Args:
          console: to show it on.
          records: receive the metrics of every report.
          quiet: record, but show nothing.
        """
        self._console, self._records, self._quiet = console, records, quiet
        self._tasks: dict[str, rich.progress.TaskID] = {}
        self._first: dict[str, tuple[float, int]] = {}
        self._last: dict[str, float] = {}
        self._begin = time.perf_counter()
        columns = rich.progress
        is_wide = console.width >= _WIDE
        self._progress = rich.progress.Progress(
            columns.TextColumn("{task.description}", table_column=Column(min_width=15)),
            *([columns.BarColumn()] if is_wide else []),
            *(
                columns.TextColumn(f"{{task.fields[{name}]}}", table_column=Column(min_width=width))
                for name, width in {"count": 10, "rate": 7, "left": 10, "metrics": 0}.items()
            ),
            console=console,
            disable=quiet or not console.is_terminal,
        )

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
        if self._console.is_terminal:
            self._show_bar(stage, done, total, text)
        else:
            self._show_line(stage, done, total, text)

    def _show_bar(self, stage: str, done: int, total: int, text: str) -> None:
        if stage not in self._tasks:
            self._tasks[stage] = self._progress.add_task(
                stage, total=None, count="compiling", rate="", left="", metrics=""
            )
        if not total:
            return
        rate, left = self._rate(stage, done, total, time.perf_counter())
        self._progress.update(
            self._tasks[stage],
            completed=done,
            total=total,
            count=f"{done}/{total}",
            rate=rate,
            left=left,
            metrics=text,
        )
        # Stages without a total never report that they end.
        for other in self._progress.tasks:
            if other.total is None and other.description != stage:
                self._progress.update(other.id, visible=False)

    def _rate(self, stage: str, done: int, total: int, now: float) -> tuple[str, str]:
        """Rate and time left as text; empty at the end of the first chunk."""
        since, before = self._first.setdefault(stage, (now, done))
        if done <= before or now <= since:
            return "", ""
        rate = (done - before) / (now - since)
        return f"{rate:.0f}/s", f"{(total - done) / rate:.0f} s left"

    def _show_line(self, stage: str, done: int, total: int, text: str) -> None:
        """Prints a line for each stage every few seconds, always its first and last."""
        now = time.perf_counter()
        clock = f"{now - self._begin:6.1f} s  {stage}"
        if not total:
            if stage not in self._last:
                self._last[stage] = now
                say(f"{clock}: compiling")
            return
        is_first = stage not in self._first
        rate, left = self._rate(stage, done, total, now)
        if done < total and not is_first and now - self._last[stage] < _LINE_PERIOD:
            return
        self._last[stage] = now
        parts = [f"{done} of {total}", rate, left]
        progress = "done" if done == total == 1 else ", ".join(part for part in parts if part)
        say(f"{clock}: {progress}  {text}".rstrip())


def as_text(console: rich.console.Console, table: Table) -> str:
    """A table as a console shows it; markup in cells is not interpreted.

    Args:
      console: on which it will be printed.
      table: the table.
    """
    drawn = rich.table.Table("", box=rich.box.SIMPLE, pad_edge=False, title_justify="left")
    drawn.title = rich.text.Text(table.caption)
    for name in table.columns:
        drawn.add_column(rich.text.Text(name), justify="right")
    for r, (name, values) in enumerate(table.rows):
        cells = (
            rich.text.Text(value, "bold" if (r, i) in table.best else "")
            for i, value in enumerate(values)
        )
        drawn.add_row(rich.text.Text(name), *cells)
    if not console.is_terminal:
        # Even the nothing that it writes while it is captured fails on a full disk.
        nowhere = io.TextIOWrapper(io.BytesIO(), getattr(console.file, "encoding", None))
        console = rich.console.Console(file=nowhere, width=_ENDLESS)
    with console.capture() as captured:
        console.print(drawn)
        if table.note:
            console.print(rich.text.Text(table.note))
    return captured.get().removesuffix("\n")
