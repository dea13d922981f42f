"""What a program shows of its progress."""

import time
from collections.abc import Callable

import rich.console
import rich.progress


class Display:
    """Progress of a run: a live bar for each stage, or plain lines where there is no terminal."""

    def __init__(self, console: rich.console.Console, record: Callable[..., None] | None = None):
        """Shows progress on a console; `record` takes the figures of every report."""
        self._console = console
        self._record = record
        self._tasks: dict[str, rich.progress.TaskID] = {}
        self._first: dict[str, float] = {}
        self._begin = time.perf_counter()
        columns = rich.progress
        self._progress = rich.progress.Progress(
            columns.TextColumn("{task.description:<16}"),
            columns.BarColumn(),
            columns.MofNCompleteColumn(),
            columns.TextColumn("{task.fields[rate]:>12}"),
            columns.TimeElapsedColumn(),
            columns.TextColumn("left"),
            columns.TimeRemainingColumn(),
            columns.TextColumn("{task.fields[figures]}"),
            console=console,
            disable=not console.is_terminal,
        )

    def __enter__(self) -> "Display":
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def show(self, stage: str, done: int, total: int, figures: dict[str, float]) -> None:
        """Takes a report of a `Monitor`; one without a total says that a stage compiles."""
        if total and self._record:
            self._record(stage=stage, step=done, **figures)
        text = "  ".join(f"{name} {value:.4g}" for name, value in figures.items())
        if not self._console.is_terminal:
            self._show_line(stage, done, total, text)
            return
        if stage not in self._tasks:
            for earlier in self._tasks.values():
                task = self._progress.tasks[earlier]
                self._progress.update(earlier, completed=task.total or 1, total=task.total or 1)
            self._tasks[stage] = self._progress.add_task(
                stage, total=None, rate="compiling", figures=""
            )
        if total:
            task = self._progress.tasks[self._tasks[stage]]
            rate = f"{task.speed:.0f}/s" if task.speed else ""
            self._progress.update(task.id, completed=done, total=total, rate=rate, figures=text)

    def _show_line(self, stage: str, done: int, total: int, text: str) -> None:
        now = time.perf_counter()
        clock = f"{now - self._begin:6.1f} s  {stage}"
        if not total and stage not in self._first:
            self._first[stage] = now
            print(f"{clock}: compiling", flush=True)
        elif total:
            rate = done / max(now - self._first.setdefault(stage, self._begin), 1e-9)
            left = (total - done) / max(rate, 1e-9)
            progress = f"{done} of {total}, {rate:.0f}/s, {left:.0f} s left"
            progress = "done" if total == 1 else progress
            print(f"{clock}: {progress}  {text}", flush=True)
