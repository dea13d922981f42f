"""`python -m jaxsense.evaluate RUN_DIR`: missions with the policies of a finished run."""

import contextlib
import dataclasses
import sys
import time
from pathlib import Path
from typing import Annotated, Any

import jax
import rich.box
import rich.console
import rich.table
import tyro

from jaxsense import cli, mission
from jaxsense.config import Config, ConfigError
from jaxsense.config.checks import require, require_types
from jaxsense.config.mission import MOST_EPISODES
from jaxsense.run import devices, files, missions, rundir
from jaxsense.run.compilation import Compiler
from jaxsense.run.monitor import Monitor, StageError
from jaxsense.show import animation, metrics, page
from jaxsense.show.terminal import Display
from jaxsense.sim.arena import TIMESTEP
from jaxsense.types import Belief

PROGRAM = "jaxsense.evaluate"


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Play missions with the policies of a finished run, and compare them in the same arenas."""

    run: Annotated[Path, tyro.conf.Positional]
    """Directory of the run."""
    episodes: int = 256
    """Missions of each policy."""
    seed: int = 0
    """Seed of the arenas and of all noise, from 0 to 2^32 - 1."""
    policy: str = "all"
    """`latent`, `naive` or `random`; `MODALITY_alone`, `MODALITY_stops` or `MODALITY_blind`, for
    example `camera_alone`: the latent policy where that robot is alone, stops or goes blind after
    6 s; `policies` for the first three, or `all`."""
    devices: int | None = None
    """Devices that missions are split over: accelerators, or threads of the CPU. By default all
    accelerators there are; on a CPU as many threads as cores, at most 8."""
    cache: Path | None = Path("~/.cache/jaxsense")
    """Directory in which compiled programs are kept for later runs; `None` to keep none."""
    animate: bool = False
    """Also write an animation of the first mission as `mission-POLICY-SEED.svg`."""
    trust: bool = False
    """Run the functions that the run's `config.json` names for sensors of one's own."""

    def __post_init__(self):
        require_types(self, bits=64)
        most = f"must be within 1 and {MOST_EPISODES:,}"
        require(1 <= self.episodes <= MOST_EPISODES, self, "episodes", most)
        require(0 <= self.seed < 2**32, self, "seed", "must be within 0 and 2^32 - 1")
        cli.require_directory("cache", self.cache)


def main(argv: list[str] | None = None) -> None:
    """The program."""
    arguments = cli.parse(PROGRAM, Arguments, sys.argv[1:] if argv is None else argv)
    try:
        workers = devices.start(arguments.devices)
        config, models = rundir.load(arguments.run, arguments.trust)
        played = _cases(arguments, config)
        path = arguments.run / "summary.json"
        # Now, not after minutes of work, is the time to find out that they cannot be written.
        with files.locked(arguments.run, waits=True):
            summary = rundir.read_summary(arguments.run)
            page.write(arguments.run, config, summary)
            rundir.write_json(path, summary)
    except ConfigError as error:
        cli.fail(PROGRAM, str(error))
    except OSError as error:
        cli.fail(PROGRAM, f"run = {str(arguments.run)!r}: cannot be used ({cli.reason(error)})")
    kept = cli.keep_programs(PROGRAM, arguments.cache, config)
    console = rich.console.Console()
    key = jax.random.key(arguments.seed)
    team = mission.make_mission(config)
    with Display(console) as display, Compiler(Monitor(display.show), kept) as compiler:
        number = arguments.episodes * len(played)
        player = missions.Player(team, compiler, missions.batch_of(number), workers)
        player.wait()
        begin = time.perf_counter()
        try:
            found = player.play(key, models, played, arguments.episodes)
        except StageError as error:
            cli.fail(PROGRAM, str(error))
        seconds = time.perf_counter() - begin
        compiling = compiler.monitor.seconds["mission"]["compile_s"]
    block = missions.summary(team, found)
    try:
        written = _write(arguments, config, models.class_beliefs, block, found.recording)
    except OSError as error:
        cli.fail(PROGRAM, f"run = {str(arguments.run)!r}: cannot be written ({cli.reason(error)})")
    rate = found.control_steps / seconds
    with contextlib.suppress(OSError):  # as in `display.say`
        _print_table(console, block)
        console.print(
            f"{number} missions in {seconds:.1f} s after {compiling:.0f} s of compilation: "
            f"{rate:.0f} control steps/s, "
            f"{rate * config.mission.control_period / TIMESTEP:.0f} physics steps/s"
        )
        for line in written:
            console.print(line)


def _write(
    arguments: Arguments,
    config: Config,
    class_beliefs: Belief,
    found: dict[str, Any],
    recording: missions.Recording,
) -> list[str]:
    """Writes the metrics into the run's summary and its page, and the animation if asked for.

    Returns:
      Lines that say where they are.
    """
    path, written = arguments.run / "summary.json", []
    if arguments.animate:
        name = next(name for name in found if name != "bytes_per_detection")
        film = arguments.run / f"mission-{name}-{arguments.seed}.svg"
        title = f"{name} policy, seed {arguments.seed}".replace("_", " ")
        animation.write(film, config, recording, class_beliefs, title)
        written.append(f"The first mission of {name} is in {film}.")
    # Another evaluation may have written its own metrics since this one began.
    with files.locked(arguments.run, waits=True):
        summary = rundir.read_summary(arguments.run)
        summary["mission"] = _merge(summary["mission"], found, arguments)
        rundir.write_json(path, summary)
        report = page.write(arguments.run, config, summary)
    return [*written, f"The metrics are in {path}, and with all others in {report}."]


def _merge(before: dict[str, Any], found: dict[str, Any], arguments: Arguments) -> dict[str, Any]:
    """The new blocks, each with its seed, and those of before of what was not played now."""
    new = {
        name: {**block, "seed": arguments.seed} if name != "bytes_per_detection" else block
        for name, block in found.items()
    }
    return {**before, **new}


def _cases(arguments: Arguments, config: Config) -> dict[str, mission.Case]:
    """What is to be played; a `ConfigError` names what cannot be."""
    # As many as one of the run's own evaluations may have, with these settings.
    settings = dataclasses.replace(config.mission, episodes=arguments.episodes)
    dataclasses.replace(config, mission=settings)
    cases = mission.cases(config)
    if arguments.policy == "all":
        return cases
    if arguments.policy == "policies":
        return {name: cases[name] for name in mission.POLICIES}
    if arguments.policy not in cases:
        known = ", ".join(["all", "policies", *cases])
        raise ConfigError("policy", arguments.policy, f"must be one of {known}")
    return {arguments.policy: cases[arguments.policy]}


def _print_table(console: rich.console.Console, found: dict[str, Any]) -> None:
    """All cases beside one another."""
    columns = [metric.label for metric in metrics.MISSIONS]
    table = rich.table.Table("policy", *columns, box=rich.box.SIMPLE, pad_edge=False)
    blocks = {name: block for name, block in found.items() if name != "bytes_per_detection"}
    for name, block in blocks.items():
        table.add_row(name, *(metric.text(block) for metric in metrics.MISSIONS))
    console.print(table)
    for metric in metrics.MISSIONS:
        if metric.meaning:
            console.print(f"{metric.label}: {metric.meaning}", markup=False, style="dim")
    if {"latent", "naive"} <= set(blocks):
        ratio = blocks["latent"]["time_s"] / blocks["naive"]["time_s"]
        console.print(f"The latent policy takes {ratio:.2f} of the time of the naive one.")
    for name, block in blocks.items():
        others = {reason: n for reason, n in block["ended"].items() if reason != "finished"}
        if others:
            reasons = ", ".join(f"{n} {reason}" for reason, n in others.items())
            console.print(f"{name}: of {block['episodes']} missions {reasons}")
    size = found["bytes_per_detection"]
    console.print(
        f"A detection takes {size['latent']:.0f} bytes in the map and {size['raw']:.0f} as a raw "
        f"scan, {size['raw'] / size['latent']:.0f} times as much."
    )


if __name__ == "__main__":
    cli.run(main)
