"""`python -m jaxsense.train`: the whole pipeline, from scanlines to policies, in one command."""

import dataclasses
import logging
import re
import shlex
import shutil
import sys
import time
from collections.abc import Callable
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any, Literal

import jax
import rich.console
import rich.table
import tyro
from jax.sharding import Mesh

from jaxsense import (
    animation,
    cli,
    devices,
    page,
    pipeline,
    report,
    rundir,
    seeds,
    sweep,
    tensorboard,
)
from jaxsense.config import PRESETS, Config, ConfigError
from jaxsense.display import Display
from jaxsense.interrupt import on_interrupt
from jaxsense.monitor import Monitor, StageError, Stopped
from jaxsense.pipeline import RunResult
from jaxsense.rundir import RunDirectory, Settings
from jaxsense.sim import sensors

PROGRAM = "jaxsense.train"
_INTERRUPTED = 130  # exit status, as shells give it


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
    num_seeds: int = 1
    """Seeds to train side by side in one program, from `seed` on; each gets a directory in that of
    the run, which holds their means and 95% intervals."""
    file: Annotated[Path | None, tyro.conf.arg(name="config")] = None
    """The `config.json` of a run, to start from its preset, seed and settings."""
    resume: Path | None = None
    """Directory of a run that was stopped, to go on in it with its settings."""
    quiet: bool = False
    """Show nothing but errors and where everything is."""
    tensorboard: bool = False
    """Also write event files for TensorBoard, into `tensorboard/` of the run."""
    devices: int | None = None
    """Devices that environments are split over: accelerators, or threads of the CPU. By default all
    accelerators there are; on a CPU as many threads as cores, at most 8, for simulations, and one
    for Q-learning."""
    cache: Path | None = Path("~/.cache/jaxsense")
    """Directory in which compiled programs are kept for later runs; `None` to keep none."""

    @property
    def settings(self) -> Settings:
        """What the results follow from."""
        return Settings(self.preset, self.seed, self.config, self.num_seeds)


def main(
    argv: list[str] | None = None, change: Callable[[Config], Config] = lambda config: config
) -> None:
    """The program.

    Args:
      argv: the command line without the program; that of the process if not given.
      change: what a program of your own makes of a preset, before the other options change that.
    """
    begin = time.perf_counter()
    # Orbax logs what it raises as well, which here comes as one line.
    logging.getLogger("absl").setLevel(logging.CRITICAL)
    arguments = parse(sys.argv[1:] if argv is None else argv, change)
    console = rich.console.Console(quiet=arguments.quiet)
    try:
        meshes = devices.start(arguments.devices, arguments.config.dqn)
        run = _open(arguments)
        records = [run.append_metrics]
        if arguments.tensorboard:
            records.append(tensorboard.make_writer(run.path / "tensorboard"))
        display = Display(console, *records, quiet=arguments.quiet)
        with run.locked(), display:
            _train(begin, arguments, run, meshes, display)
    except ConfigError as error:
        cli.fail(PROGRAM, str(error))
    except OSError as error:
        # A full disk, mostly. What is there was written as a whole, or not at all.
        cli.fail(PROGRAM, f"cannot write {error}; what was saved before is still there")
    first = run.path if arguments.num_seeds == 1 else _of_seed(run, arguments.seed).path
    if not arguments.quiet:
        _print_summary(console, run)
    # The one thing that a quiet run says.
    print(f"Everything is in {run.path}; open {first / 'report.html'} first.")
    print(f"Next: python -m jaxsense.evaluate {shlex.quote(str(first))} --animate")


def parse(argv: list[str], change: Callable[[Config], Config] = lambda config: config) -> Arguments:
    """Reads the command line; ends the program with status 2 and one line if it is wrong."""
    try:
        stored = _stored(argv, change)
        default: Any = Arguments(
            config=stored.config,
            preset=stored.preset,  # pyright: ignore[reportArgumentType]
            seed=stored.seed,
            num_seeds=stored.num_seeds,
        )
        arguments = cli.parse(PROGRAM, Arguments, argv, default)
        sensors.make(arguments.config)
        if not 0 <= arguments.seed < 2**32:
            raise ConfigError("seed", arguments.seed, "must be within 0 and 2^32 - 1")
        if arguments.seed + arguments.num_seeds > 2**32:
            raise ConfigError("num_seeds", arguments.num_seeds, "leads beyond seed 2^32 - 1")
        if arguments.num_seeds > 1 and arguments.devices is not None:
            reason = "cannot be chosen for several seeds, which are one program on one device"
            raise ConfigError("devices", arguments.devices, reason)
        if arguments.num_seeds < 1:
            raise ConfigError("num_seeds", arguments.num_seeds, "must be greater than 0")
        if arguments.file is not None and _option(argv, "preset"):
            raise ConfigError("config", str(arguments.file), "holds a preset; give no --preset")
        if arguments.resume is not None:
            if arguments.out is not None or arguments.file is not None:
                reason = "goes on in its own directory; give no --out and no --config"
                raise ConfigError("resume", str(arguments.resume), reason)
            if arguments.settings != stored:
                reason = "goes on with its own settings; give none that differ"
                raise ConfigError("resume", str(arguments.resume), reason)
    except ConfigError as error:
        cli.fail(PROGRAM, str(error))
    return arguments


def _stored(argv: list[str], change: Callable[[Config], Config]) -> Settings:
    """The settings that the other options change, which must be known before they are read."""
    resume, file = _option(argv, "resume"), _option(argv, "config")
    if resume:
        return RunDirectory.resume(Path(resume)).settings
    if file:
        return rundir.read_settings(Path(file))
    preset = _option(argv, "preset") or "default"
    if preset not in PRESETS:
        raise ConfigError("preset", preset, f"must be one of {', '.join(PRESETS)}")
    return Settings(preset, 0, change(PRESETS[preset]))


def _option(argv: list[str], name: str) -> str | None:
    """What is given for an option last, if it is given."""
    found = re.findall(rf"(?:^|\0)--{name}(?:=|\0)([^\0]+)", "\0".join(argv))
    return found[-1] if found else None


def _open(arguments: Arguments) -> RunDirectory:
    """The run directory, which is made unless the run goes on."""
    if arguments.resume is not None:
        return RunDirectory.resume(arguments.resume)
    name = f"{datetime.now():%Y%m%d-%H%M%S}-{arguments.preset}"
    return RunDirectory.create(arguments.out or Path("runs") / name, arguments.settings)


def _train(
    begin: float,
    arguments: Arguments,
    run: RunDirectory,
    meshes: tuple[Mesh | None, Mesh | None],
    display: Display,
) -> None:
    """Trains, and writes all that a finished run holds."""
    config = arguments.config
    kept = cli.keep_programs(PROGRAM, arguments.cache, config)
    monitor = Monitor(display.show)

    def stop() -> None:
        monitor.stop()
        display.note("Stopping as soon as all is saved; Ctrl-C again does not wait for that.")

    try:
        with on_interrupt(stop):
            if arguments.num_seeds > 1:
                numbers = range(arguments.seed, arguments.seed + arguments.num_seeds)
                results = seeds.run(numbers, config, monitor, run.checkpoints, kept)
            else:
                key = jax.random.key(arguments.seed)
                result = pipeline.run(key, config, monitor, run.checkpoints, *meshes, kept)
                results = {arguments.seed: result}
            timing = {"total_s": time.perf_counter() - begin, "stages": monitor.seconds}
            if arguments.num_seeds == 1:
                _write(run, results[arguments.seed], timing)
            else:
                _write_seeds(run, results, timing)
    except Stopped:
        is_one = run.settings.num_seeds == 1
        saved = "all that was trained" if is_one else "what all seeds have finished"
        go_on = f"python -m {PROGRAM} --resume {shlex.quote(str(run.path))}"
        print(f"Stopped; {saved} is saved. To go on: {go_on}", file=sys.stderr)
        sys.exit(_INTERRUPTED)
    except StageError as error:
        cli.fail(PROGRAM, f"{error}; must be finite. What was written before is in {run.path}")


def _write_seeds(run: RunDirectory, results: dict[int, RunResult], timing: dict[str, Any]) -> None:
    """A directory for each seed, and what they have in common."""
    for seed, result in results.items():
        of_seed = _of_seed(run, seed)
        of_seed.path.mkdir(exist_ok=True)
        shutil.copy(run.path / "config.json", of_seed.path)
        of_seed.save_models(result.models)
    for seed, result in results.items():
        _write(_of_seed(run, seed), result, timing)
    summaries = {str(seed): result.summary for seed, result in results.items()}
    over_seeds = sweep.statistics(list(summaries.values()))
    run.write_json("summary.json", {**_header(run, timing), "seeds": summaries, **over_seeds})
    run.checkpoints.forget()


def _of_seed(run: RunDirectory, seed: int) -> RunDirectory:
    """The run directory of one of several seeds."""
    settings = dataclasses.replace(run.settings, seed=seed)
    return RunDirectory(run.path / f"seed-{seed}", settings)


def _write(run: RunDirectory, result: RunResult, timing: dict[str, Any]) -> None:
    """Plots, the report and at last the summary, which says that the run is finished."""
    config = run.settings.config
    report.write_plots(run.path, config, result)
    film, beliefs = run.path / "mission.svg", result.models.class_beliefs
    animation.write(film, config, result.recording, beliefs, "latent policy")
    summary = {**_header(run, timing), **result.summary}
    page.write(run.path, summary)
    run.write_json("summary.json", summary)


def _header(run: RunDirectory, timing: dict[str, Any]) -> dict[str, Any]:
    """What a summary says of the run itself."""
    settings = run.settings
    return {
        "preset": settings.preset,
        "seed": settings.seed,
        "versions": rundir.versions(),
        "devices": [device.device_kind for device in jax.devices()],
        "timing": timing,
    }


def _print_summary(console: rich.console.Console, run: RunDirectory) -> None:
    """A table of the figures that matter most; of several seeds mean and 95% interval."""
    summary = rundir.read_summary(run.path)
    settings, policies = run.settings, summary["dqn"]
    seeds = f", seed {settings.seed}"
    if settings.num_seeds > 1:
        last = settings.seed + settings.num_seeds - 1
        seeds = f", seeds {settings.seed} to {last}: mean, 95% interval"
    table = rich.table.Table("figure", *policies, title=f"{settings.preset} preset{seeds}")
    table.add_row(
        "detector accuracy",
        *(_figure(summary["detectors"][modality]["accuracy"]) for modality in policies),
    )
    rows = {
        "episode reward, DQN": "return",
        "episode reward, optimal": "optimal",
        "episode reward, naive": "naive",
        "episode reward, random": "random",
        "fraction of optimal": "fraction_of_optimal",
        "optimal in states": "optimal_states",
        "states": "num_states",
    }
    for name, key in rows.items():
        table.add_row(name, *(_figure(policy.get(key)) for policy in policies.values()))
    console.print(table)
    console.print(
        f"latent units in use: {_figure(summary['jmvae']['active_units'])}, "
        f"total time: {summary['timing']['total_s']:.0f} s"
    )


def _figure(value: Any) -> str:
    """A figure as a cell of the table."""
    if isinstance(value, dict):
        return f"{value['mean']:.4g}, {value['low']:.4g} to {value['high']:.4g}"
    return "" if value is None else f"{value:.5g}"


if __name__ == "__main__":
    cli.run(main)
