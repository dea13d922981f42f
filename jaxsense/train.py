"""`python -m jaxsense.train`: the whole pipeline, from scanlines to policies, in one command."""

import contextlib
import dataclasses
import importlib.metadata
import io
import re
import sys
import time
from datetime import datetime
from pathlib import Path
from typing import Annotated, Literal, NoReturn

import jax
import rich.console
import rich.progress
import rich.table
import tyro

from jaxsense import __version__, pipeline, report
from jaxsense.config import PRESETS, Config, ConfigError
from jaxsense.monitor import Monitor, StageError
from jaxsense.rundir import RunDirectory

_PACKAGES = ("jax", "jaxlib", "flax", "optax", "mujoco", "mujoco-mjx", "numpy")


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Train detectors, the JMVAE and one Q-network per modality, and write a run directory."""

    config: Annotated[Config, tyro.conf.arg(name="")]
    preset: Literal["default", "paper", "smoke"] = "default"
    """Settings to start from; every option below changes one of them."""
    seed: int = 0
    """Seed of all randomness, from 0 to 2^32 - 1."""
    out: Path | None = None
    """Directory to write; must be new. By default `runs/DATE-TIME-PRESET`."""


def main(argv: list[str] | None = None) -> None:
    """The program."""
    begin = time.perf_counter()
    arguments = parse(sys.argv[1:] if argv is None else argv)
    console = rich.console.Console()
    name = f"{datetime.now():%Y%m%d-%H%M%S}-{arguments.preset}"
    try:
        run = RunDirectory(
            arguments.out or Path("runs") / name,
            arguments.config,
            arguments.preset,
            arguments.seed,
        )
    except ConfigError as error:
        _exit(str(error))
    with Display(console, run) as display:
        monitor = Monitor(display.show)
        try:
            result = pipeline.run(
                jax.random.key(arguments.seed), arguments.config, monitor, run.save
            )
        except StageError as error:
            _exit(f"{error}; must be finite. What was written before is in {run.path}")
    report.write_plots(run.path, arguments.config, result)
    summary = {
        "preset": arguments.preset,
        "seed": arguments.seed,
        "versions": {
            "jaxsense": __version__,
            **{package: importlib.metadata.version(package) for package in _PACKAGES},
        },
        "devices": [device.device_kind for device in jax.devices()],
        "timing": {"total_s": time.perf_counter() - begin, "stages": monitor.seconds},
        **result.summary,
    }
    run.write_json("summary.json", summary)
    _print_summary(console, summary)
    console.print(f"Everything is in {run.path}; look at {run.path / 'latent_space.png'} first.")


def parse(argv: list[str]) -> Arguments:
    """Reads the command line; ends the program with status 2 and one line if it is wrong."""
    preset = _preset_of(argv)
    messages = io.StringIO()
    try:
        with contextlib.redirect_stderr(messages):
            arguments = tyro.cli(
                Arguments,
                prog="python -m jaxsense.train",
                default=Arguments(PRESETS[preset], preset),  # pyright: ignore[reportArgumentType]
                args=argv,
            )
    except ConfigError as error:
        _exit(str(error))
    except SystemExit as stop:
        if stop.code == 0:
            raise
        _exit(_one_line(messages.getvalue()))
    if not 0 <= arguments.seed < 2**32:
        _exit(f"seed = {arguments.seed}: must be within 0 and 2^32 - 1")
    return arguments


def _preset_of(argv: list[str]) -> str:
    """The preset that the other options change, which must be known before they are read."""
    text = " ".join(argv)
    found = re.findall(r"(?:^|\s)--preset(?:=|\s+)(\S+)", text)
    preset = found[-1] if found else "default"
    if preset not in PRESETS:
        _exit(f"preset = {preset!r}: must be one of {', '.join(PRESETS)}")
    return preset


def _one_line(message: str) -> str:
    """What tyro says in a box, as one line without the box and without the help text."""
    _, *lines = message.splitlines()  # the first is the title of the box
    flat = " ".join(re.sub(r"[╰╯│─]|-{4,}", " ", " ".join(lines)).split())
    error = re.split(r" (?:For full helptext|Argument helptext|Perhaps you meant)", flat)[0]
    error = re.sub(r"^.*?Error parsing (?:config\S* )?", "", error)
    error = re.sub(r"invalid literal for int.*?: (.*)", r"\1 must be a whole number", error)
    error = re.sub(r"could not convert string to float: (.*)", r"\1 must be a number", error)
    similar = re.search(r"Perhaps you meant: (--\S+)", flat)
    return f"{error}; perhaps {similar[1]}" if similar else error


def _exit(message: str) -> NoReturn:
    """Ends the program for a reason that is the user's to mend."""
    print(f"jaxsense.train: {message} (--help tells every option)", file=sys.stderr)
    sys.exit(2)


class Display:
    """Progress of a run: a live bar for each stage, or plain lines where there is no terminal."""

    def __init__(self, console: rich.console.Console, run: RunDirectory):
        self._console = console
        self._run = run
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
        if total:
            self._run.append_metrics(stage=stage, step=done, **figures)
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
            rate = done / (now - self._first[stage])
            left = (total - done) / rate
            progress = f"{done} of {total}, {rate:.0f}/s, {left:.0f} s left"
            progress = "done" if total == 1 else progress
            print(f"{clock}: {progress}  {text}", flush=True)


def _print_summary(console: rich.console.Console, summary: dict) -> None:
    """A table of the figures that matter most."""
    table = rich.table.Table("figure", *summary["dqn"], title=f"{summary['preset']} preset")
    rows = {
        "detector accuracy": lambda m: f"{summary['detectors'][m]['accuracy']:.4f}",
        "episode reward, DQN": lambda m: f"{summary['dqn'][m]['return']:.3f}",
        "episode reward, optimal": lambda m: f"{summary['dqn'][m]['optimal']:.3f}",
        "episode reward, naive": lambda m: f"{summary['dqn'][m]['naive']:.3f}",
        "episode reward, random": lambda m: f"{summary['dqn'][m]['random']:.3f}",
        "fraction of optimal": lambda m: str(summary["dqn"][m]["fraction_of_optimal"])[:6],
        "optimal in states": lambda m: (
            f"{summary['dqn'][m]['optimal_states']} of {summary['dqn'][m]['num_states']}"
        ),
    }
    for name, cell in rows.items():
        table.add_row(name, *(cell(m) for m in summary["dqn"]))
    console.print(table)
    console.print(
        f"latent units in use: {summary['jmvae']['active_units']}, "
        f"total time: {summary['timing']['total_s']:.0f} s"
    )


if __name__ == "__main__":
    main()
