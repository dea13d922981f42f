"""`python -m jaxsense.train`: trains the whole pipeline, from scanlines to policies."""

import contextlib
import dataclasses
import functools
import importlib.util
import itertools
import shlex
import sys
import tempfile
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import ModuleType
from typing import NoReturn

import jax
import numpy as np

from jaxsense.config import PRESETS, Config, ConfigError
from jaxsense.config.options import command, given
from jaxsense.config.section import Checked, limited, require_known
from jaxsense.looks import beyond_training
from jaxsense.mission.outcome import require_playable
from jaxsense.run import cli, devices, output, pipeline, rundir
from jaxsense.run.compilation import Compiler
from jaxsense.run.devices import MAX_DEVICES
from jaxsense.run.monitor import Monitor, StageError, Stopped
from jaxsense.run.output import on_interrupt, say
from jaxsense.run.programs import OwnPolicies, Programs
from jaxsense.run.rundir import RunDirectory
from jaxsense.run.settings import Settings, read_settings, resumable
from jaxsense.show import terminal
from jaxsense.show.terminal import Display
from jaxsense.summary import blocks, compare, tables
from jaxsense.summary.blocks import Header, Origin
from jaxsense.summary.read import read_origins, read_summary

PROGRAM = "jaxsense.train"

_COMMON = (
    *("--preset", "--seed", "--num-seeds", "--out", "--config", "--resume", "--devices"),
    *("--cache", "--quiet", "--tensorboard", "--trust", "--modalities", "--robots"),
    *("--arena.side", "--arena.num-pois", "--arena.classes", "--jmvae.fusion", "--jmvae.alpha"),
    *("--dqn.task", "--dqn.epochs", "--mission.episodes"),
)
"""Options that `--help` shows."""


class Arguments(Checked):
    """Trains detectors, the JMVAE and one Q-network per modality, and writes a run directory.

    Attributes:
      settings: The settings that determine the results.
      out: Directory to write, new or empty; by default `runs/DATE-TIME-PRESET`.
      config: The `config.json` of a run whose preset, seed and settings the new run starts from, or
        a `.toml` file of this form, such as a copy of `jaxsense/config/presets/noisy.toml`.
      resume: Directory of a stopped run to continue, with its own settings.
      trust: Trust the `config.json` of `--config` or `--resume`: run the code of custom sensors
        that it names.
      quiet: Print only errors, the path of the results and the next command.
      tensorboard: Also write event files for TensorBoard, to `tensorboard/` in the run.
      devices: Number of accelerators, or of CPU threads, that share scenes and missions. By default
        all accelerators, or one thread per core, at most 8.
      coordinator: `HOST:PORT` of the first of several processes that share scenes and missions.
        Start all of them with the same options except `--process-index`; the first one writes the
        run.
      num_processes: Number of processes that share the run.
      process_index: Index of this process, from 0.
      cache: Directory in which to cache compiled programs; `none` for no cache.
    """

    settings: Settings = Settings()
    out: Path | None = None
    config: Path | None = None
    resume: Path | None = None
    trust: bool = False
    quiet: bool = False
    tensorboard: bool = False
    devices: int | None = limited(None, at_least=1, at_most=MAX_DEVICES)
    coordinator: str | None = None
    num_processes: int | None = limited(None, at_least=1)
    process_index: int | None = limited(None, at_least=0)
    cache: Path | None = cli.CACHE


def main(
    argv: list[str] | None = None,
    change: Callable[[Config], Config] = lambda config: config,
    policies: OwnPolicies | None = None,
) -> None:
    """Runs the program.

    Args:
      argv: the command line without the program; by default the process's own.
      change: changes a preset in your own program, before the other options do.
      policies: custom policies by name; missions play those that `config.mission.policies` names.
    """
    arguments = parse(sys.argv[1:] if argv is None else argv, change, policies)
    is_quiet = arguments.quiet
    if is_helper := bool(arguments.process_index):
        arguments = dataclasses.replace(arguments, quiet=True, tensorboard=False)
    with cli.ending(PROGRAM, "; earlier checkpoints are intact"):
        # Before joining, so that no process waits for a first one that refuses its options.
        with _open(arguments) as run:
            run.check_seeds()
            devices.join(
                arguments.coordinator,
                arguments.num_processes,
                arguments.process_index,
                quiet=is_quiet,
            )
            _train(arguments, run, policies)
        devices.leave()
    if is_helper:
        return
    if not arguments.quiet:
        _print_summary(run)
    # A quiet run prints only these two lines.
    first = next(path for path in run.seeds.values() if (path / "report.html").exists())
    say(f"Results are in {run.path}. Start with {run.path / 'report.html'}.")
    trust = " --trust" if arguments.settings.config.named_code else ""
    say(f"Next: {command('jaxsense.evaluate')} {shlex.quote(str(first))} --animate{trust}")


def parse(
    argv: list[str],
    change: Callable[[Config], Config] = lambda config: config,
    policies: OwnPolicies | None = None,
) -> Arguments:
    """Reads the command line, or ends the program with status 2 and one line if it is wrong.

    Args:
      argv: the command line without the program.
      change: changes a preset before the other options do.
      policies: custom policies by name.
    """
    with cli.ending(PROGRAM):
        stored = _stored(argv, change)
        arguments = cli.parse(PROGRAM, Arguments(stored), argv, _COMMON)
        require_playable(arguments.settings.config, policies)
        if arguments.tensorboard and importlib.util.find_spec("tensorboardX") is None:
            reason = "needs tensorboardX: pip install 'jaxsense[tensorboard]'"
            raise ConfigError("tensorboard", True, reason)
        if arguments.config is not None and arguments.settings.preset != stored.preset:
            raise ConfigError("config", str(arguments.config), "has a preset; omit --preset")
        if arguments.resume is not None:
            resume, is_elsewhere = str(arguments.resume), arguments.out or arguments.config
            if is_elsewhere:
                reason = "resumes in its own directory; omit --out and --config"
                raise ConfigError("resume", resume, reason)
            if arguments.settings != stored:
                raise ConfigError("resume", resume, "resumes in its own settings; omit others")
    return arguments


def _stored(argv: list[str], change: Callable[[Config], Config]) -> Settings:
    """The settings that the other options change, needed before those are read."""
    values, _ = given(Arguments, argv)
    is_trusted = values.get("trust") is True
    if isinstance(resume := values.get("resume"), Path):
        return resumable(resume, is_trusted)
    if isinstance(file := values.get("config"), Path):
        return read_settings(file, is_trusted)
    preset = str(values.get("settings.preset", "default"))
    require_known("preset", preset, PRESETS)
    return Settings(preset, 0, change(PRESETS[preset]))


@contextlib.contextmanager
def _open(arguments: Arguments) -> Iterator[RunDirectory]:
    """The run directory: a new one, the one to resume, or that of a process that only helps."""
    with contextlib.ExitStack() as stack:
        if arguments.process_index:  # nobody reads its files
            path = Path(stack.enter_context(tempfile.TemporaryDirectory())) / "run"
            opened = RunDirectory.create(path, arguments.settings)
        elif arguments.resume is not None:
            opened = RunDirectory.resume(arguments.resume, arguments.trust)
        else:
            opened = RunDirectory.create(arguments.out, arguments.settings)
        yield stack.enter_context(opened)


def _train(arguments: Arguments, run: RunDirectory, policies: OwnPolicies | None) -> None:
    """Trains the seeds that are left with the same programs, and sums all up."""
    config, failed, monitor = run.settings.config, dict[int, str](), Monitor(warn=_warn)
    workers = devices.start(arguments.devices)
    kept = cli.keep_programs(PROGRAM, arguments.cache, config, has_own_code=bool(policies))
    for what in beyond_training(config):
        _warn(what)
    is_left = np.array([not (path / "summary.json").exists() for path in run.seeds.values()])
    left = [*itertools.compress(run.seeds.items(), devices.of_first_process(is_left))]

    def stop() -> None:
        monitor.stop()
        if not arguments.quiet:
            say("Saving and stopping. Press Ctrl-C again to quit immediately.")

    try:
        with on_interrupt(stop), Compiler(monitor, kept) as compiler:
            programs = Programs(config, compiler, workers, len(left), policies)
            for seed, path in left:
                with run.of_seed(seed, path) as of_seed:
                    if reason := _train_one(arguments, of_seed, programs):
                        failed[seed] = reason
                monitor.restart()
    except Stopped:
        _end_stopped(run)
    if len(failed) == run.settings.num_seeds:
        sys.exit(2)
    # Another process has none of the seeds that were finished before.
    if run.settings.num_seeds > 1 and jax.process_index() == 0:
        _summarise_seeds(run, failed)


def _end_stopped(run: RunDirectory) -> NoReturn:
    """Says how to go on with a run, and ends the process."""
    if jax.process_index() == 0:
        again = f"{command(PROGRAM)} --resume {shlex.quote(str(run.path))}"
        again += " --trust" if run.settings.config.named_code else ""
        again += " with the same processes" if jax.process_count() > 1 else ""
        output.complain(f"Stopped; all training so far is saved. To resume: {again}")
    # Other processes may be blocked in a collective; wait only briefly.
    devices.leave(devices.LEAVE_TIMEOUT)
    sys.exit(output.INTERRUPTED)


def _train_one(arguments: Arguments, run: RunDirectory, programs: Programs) -> str | None:
    """Trains one seed and writes its run; returns why it failed, if it did."""
    records = [run.append_metrics]
    if arguments.tensorboard:
        records.append(terminal.tensorboard(run.path / "tensorboard"))
    origins = run.sign()
    if several := compare.several_origins(origins):
        _warn(f"{run.path}: {several}")
    with Display(records, arguments.quiet) as display:
        programs.monitor.begin(display.show)
        try:
            results, pictures = _results(run, programs)
        except StageError as error:
            _warn(f"{error}; earlier checkpoints are in {run.path}")
            return str(error)
        programs.monitor.check_stop()
        header = _header(run, origins)
        _write(run, {**header, "timing": programs.monitor.timing(), **results}, pictures)
    return None


def _results(
    run: RunDirectory, programs: Programs
) -> tuple[blocks.Results, dict[str, bytes | str]]:
    """Trains one seed and plays its missions; draws both meanwhile."""
    key, config = jax.random.key(run.settings.seed), run.settings.config
    # In one thread of its own, because matplotlib does not work in several at once.
    with ThreadPoolExecutor(1, "draw") as artist:
        learned = pipeline.learn(key, programs, run.checkpoints)
        of_training = artist.submit(lambda: _drawing().of_training(config, learned))
        played, block = pipeline.play(key, programs, learned, run.checkpoints)
        of_missions = artist.submit(lambda: _drawing().of_missions(config, learned, played, block))
        pictures = of_training.result() | of_missions.result()
    return {**learned.results, "mission": block}, pictures


def _summarise_seeds(run: RunDirectory, failed: dict[int, str]) -> None:
    """Writes the page, curves and summary of several seeds, without failed ones."""
    paths = [path for seed, path in run.seeds.items() if seed not in failed]
    timing, of_each, means = compare.of_seeds([read_summary(path) for path in paths])
    origins = [each for path in paths for each in read_origins(path)]
    header = _header(run, [*origins, rundir.process()])
    found: blocks.Summary = {**header, "timing": timing, "seeds": of_each, **means}
    if failed:
        found["failed"] = {str(seed): reason for seed, reason in failed.items()}
    curves = rundir.rewards(paths, run.settings.config, _warn)
    _write(run, found, _drawing().of_seeds(curves, means))


def _write(run: RunDirectory, found: blocks.Summary, pictures: dict[str, bytes | str]) -> None:
    """Writes pictures, page and summary; the last one marks the run as finished."""
    _drawing().write(run.path, run.settings.config, pictures, found)
    rundir.write_json(run.path / "summary.json", found)


def _drawing() -> ModuleType:
    """The module that draws and writes pages, imported when the first picture is drawn."""
    from jaxsense.show import drawing  # noqa: PLC0415 (matplotlib takes long to import)

    return drawing


_warn = functools.partial(cli.warn, PROGRAM)


def _header(run: RunDirectory, origins: list[Origin]) -> Header:
    """A summary's keys about the run itself, with the origins of its results if they differ."""
    found: Header = {
        "preset": run.settings.preset,
        "seed": run.settings.seed,
        **rundir.origin(),
    }
    different = [each for i, each in enumerate(origins) if each not in origins[:i]]
    return {**found, "origins": different} if compare.differences_of(different) else found


def _print_summary(run: RunDirectory) -> None:
    """Prints the main metrics; of several seeds, mean and 95% interval."""
    found, settings = read_summary(run.path), run.settings
    which = f"seed {settings.seed}"
    if settings.num_seeds > 1:
        which = f"seeds {settings.seed} to {settings.seeds[-1]}: mean, 95% interval"
    say(f"{settings.preset} preset, {which}, {found['timing']['total_s']:.0f} s in total")
    missions = tables.missions(found["mission"], "Missions")
    for table in (tables.detectors(found), tables.agents(found), missions):
        say(str(table))
    if verdict := compare.verdict(found["mission"]):
        say(verdict)
    for remark in compare.remarks(found):
        say(remark)


if __name__ == "__main__":
    output.run(main)
