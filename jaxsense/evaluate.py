"""`python -m jaxsense.evaluate RUN_DIR`: plays missions with the policies of a finished run."""

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
from jaxsense.core.types import Belief
from jaxsense.mission import compare
from jaxsense.run import devices, files, missions, rundir
from jaxsense.run.compilation import Compiler
from jaxsense.run.monitor import Monitor, StageError
from jaxsense.show import animation, metrics, page, plots
from jaxsense.show.terminal import Display
from jaxsense.sim.arena import TIMESTEP

PROGRAM = "jaxsense.evaluate"


@dataclasses.dataclass(frozen=True)
class ArenaArguments:
    """Another arena than the run's."""

    num_pois: int | None = None
    """Number of points of interest, if another than the run's."""
    side: float | None = None
    """Inner length and width of the arena, in metres, if others than the run's."""

    def __post_init__(self):
        require_types(self)


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
    """`latent`, `greedy`, `bayes`, `optimal`, `naive`, `naive_2`, `naive_3`, `random`, `nearest`,
    `auction` or `rollout`; `policies` for all; `ROBOT_alone`, `ROBOT_stops` or `ROBOT_blind`, as in
    `camera_alone`, for the latent policy where that robot is alone, stops or goes blind after 6 s;
    or `all`."""
    arena: ArenaArguments = ArenaArguments()
    robots: tuple[str, ...] | None = None
    """The robots, each the modality of its sensor, if others than the run's; for example
    `camera camera lidar`."""
    devices: int | None = None
    """Accelerators, or threads on a CPU, that share the missions. By default all accelerators, or
    as many threads as cores, at most 8."""
    cache: Path | None = cli.CACHE
    """Directory to keep compiled programs in for later runs; `None` keeps none."""
    animate: bool = False
    """Also write an animation of the first mission as `mission-POLICY-SEED.svg`."""
    trust: bool = False
    """Run the functions that the run's `config.json` names for your own sensors."""

    def __post_init__(self):
        require_types(self, bits=64)
        most = f"must be within 1 and {MOST_EPISODES:,}"
        require(1 <= self.episodes <= MOST_EPISODES, self, "episodes", most)
        require(0 <= self.seed < 2**32, self, "seed", "must be within 0 and 2^32 - 1")
        cli.require_directory("cache", self.cache)


def main(argv: list[str] | None = None) -> None:
    """Runs the program."""
    arguments = cli.parse(PROGRAM, Arguments, sys.argv[1:] if argv is None else argv)
    try:
        workers = devices.start(arguments.devices)
        trained, models = rundir.load(arguments.run, arguments.trust)
        config = _elsewhere(arguments, trained)
        team = mission.make_mission(config)
        played = _cases(arguments, team)
        path = arguments.run / "summary.json"
        # If these files cannot be written, fail now rather than after minutes of work.
        with files.locked(arguments.run, waits=True):
            summary = rundir.read_summary(arguments.run)
            _pictures(arguments.run, trained, summary)
            page.write(arguments.run, trained, summary)
            rundir.write_json(path, summary)
    except ConfigError as error:
        cli.fail(PROGRAM, str(error))
    except OSError as error:
        cli.fail(PROGRAM, f"run = {str(arguments.run)!r}: cannot be used ({cli.reason(error)})")
    kept = cli.keep_programs(PROGRAM, arguments.cache, config)
    console = rich.console.Console()
    key = jax.random.key(arguments.seed)
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
        written = _write(
            arguments, (trained, config), models.fusion.classes, block, found.recording
        )
    except OSError as error:
        cli.fail(PROGRAM, f"run = {str(arguments.run)!r}: cannot be written ({cli.reason(error)})")
    rate = found.control_steps / seconds
    with contextlib.suppress(OSError):  # as in `say`
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
    configs: tuple[Config, Config],
    class_beliefs: Belief,
    found: dict[str, Any],
    recording: missions.Recording,
) -> list[str]:
    """Writes the metrics into the run's summary and page, and the animation if requested.

    Args:
      arguments: of the program.
      configs: the settings of the run, and of these missions.
      class_beliefs: `[C, D]` beliefs of the classes.
      found: the block of the missions.
      recording: the first mission.

    Returns:
      Lines about where they are.
    """
    path, written = arguments.run / "summary.json", []
    trained, config = configs
    if arguments.animate:
        name = next(iter(metrics.cases(found)))
        place = "" if config == trained else f"-{_name(config)}"
        film = arguments.run / f"mission-{name}-{arguments.seed}{place}.svg"
        what = f" policy, seed {arguments.seed}"
        if place:
            what = f", {config.arena.num_pois} points, {len(config.carried)} robots"
        title = f"{name}{what}".replace("_", " ")
        animation.write(film, config, recording, class_beliefs, title)
        written.append(f"The first mission of {name} is in {film}.")
    # Another evaluation may have written metrics since this one began.
    with files.locked(arguments.run, waits=True):
        summary = rundir.read_summary(arguments.run)
        if config == trained:
            summary["mission"] = _merge(summary["mission"], found, arguments)
        else:
            _add_elsewhere(summary, config, found, arguments)
        pictures = _pictures(arguments.run, trained, summary)
        rundir.write_json(path, summary)
        for name, content in pictures.items():
            files.write(arguments.run / name, content)
        report = page.write(arguments.run, trained, summary)
    return [*written, f"The metrics are in {path}, and with all others in {report}."]


def _pictures(run: Path, config: Config, summary: dict[str, Any]) -> dict[str, bytes]:
    """The plots of missions; raises `ConfigError` if the summary is not that of a run."""
    with page.showing(run):
        for place in (summary, *summary.get("elsewhere", {}).values()):
            compare.compared(metrics.cases(place["mission"]))
        return plots.of_missions(config, summary)


def _merge(before: dict[str, Any], found: dict[str, Any], arguments: Arguments) -> dict[str, Any]:
    """The earlier blocks, with those of the cases played now and their seed."""
    cases = metrics.cases(found).items()
    new = {name: {**block, "seed": arguments.seed} for name, block in cases}
    blocks = compare.compared({**metrics.cases(before), **new})
    return {**before, **found, **blocks}


def _add_elsewhere(
    summary: dict[str, Any], config: Config, found: dict[str, Any], arguments: Arguments
) -> None:
    """Adds missions in another arena, or with other robots, to those that are there."""
    places = summary.setdefault("elsewhere", {})
    place = places.setdefault(
        _name(config),
        {
            "num_pois": config.arena.num_pois,
            "side": config.arena.side,
            "robots": list(config.carried),
            "mission": {},
        },
    )
    place["mission"] = _merge(place["mission"], found, arguments)


def _name(config: Config) -> str:
    """Name of an arena and a team, also for files, whose names are short."""
    numbers = {modality: config.carried.count(modality) for modality in config.carried}
    robots = "-".join(f"{number}-{modality}" for modality, number in numbers.items())
    return f"{config.arena.num_pois}-points-{config.arena.side:g}-m-{robots}"


def _elsewhere(arguments: Arguments, config: Config) -> Config:
    """The run's settings with the arena and the team of these missions."""
    sizes = dataclasses.asdict(arguments.arena)
    changed = {name: value for name, value in sizes.items() if value is not None}
    arena = dataclasses.replace(config.arena, **changed)
    # The Q-network of one agent has an input for each PoI.
    if config.dqn.task == "map" and arena.num_pois != config.arena.num_pois:
        number = config.arena.num_pois
        reason = (
            f"the policies of this run are for {number} points; must be {number}, or a run with"
        )
        raise ConfigError("arena.num_pois", arena.num_pois, f"{reason} dqn.task = team")
    robots, given = config.robots, arguments.robots
    if given is not None and sorted(given) != sorted(config.carried):
        # In one order, so that a team plays in the same arenas however it is named.
        robots = tuple(sorted(given, key=[*config.modalities, *given].index))
    # No mission starts with a map that is partly seen, which limits the number of PoIs.
    mdp = dataclasses.replace(config.mdp, partly_seen_starts=False)
    mdp = config.mdp if arena == config.arena else mdp
    return dataclasses.replace(config, arena=arena, robots=robots, mdp=mdp)


def _cases(arguments: Arguments, team: mission.Mission) -> dict[str, mission.Case]:
    """The cases to play; raises `ConfigError` for an unknown policy or too many episodes."""
    # Checked like the number of a run's own missions.
    settings = dataclasses.replace(team.config.mission, episodes=arguments.episodes)
    dataclasses.replace(team.config, mission=settings)
    cases = mission.cases(team.config, team.policies)
    if arguments.policy == "all":
        return cases
    if arguments.policy == "policies":
        return {name: cases[name] for name in team.policies}
    if arguments.policy not in cases:
        known = ", ".join(["all", "policies", *cases])
        raise ConfigError("policy", arguments.policy, f"must be one of {known}")
    return {arguments.policy: cases[arguments.policy]}


def _print_table(console: rich.console.Console, found: dict[str, Any]) -> None:
    """Prints the metrics of all cases."""
    columns = metrics.headline(metrics.MISSIONS)
    labels = [metric.label for metric in columns]
    table = rich.table.Table("policy", *labels, box=rich.box.SIMPLE, pad_edge=False)
    blocks = metrics.cases(found)
    for name, block in blocks.items():
        table.add_row(name, *(metric.text(block) for metric in columns))
    console.print(table)
    for metric in columns:
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
        f"A detection takes {size['latent']:.0f} bytes in the map, {size['features']:.0f} as the "
        f"detector's features and {size['raw']:.0f} as a raw scan."
    )


if __name__ == "__main__":
    cli.run(main)
