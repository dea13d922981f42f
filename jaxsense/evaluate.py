"""`python -m jaxsense.evaluate RUN_DIR`: plays missions with the policies of a finished run."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import jax

from jaxsense import looks, mission
from jaxsense.config import Config, ConfigError
from jaxsense.config.mission import MAX_EPISODES
from jaxsense.config.options import Positional
from jaxsense.config.section import Checked, limited, require_known
from jaxsense.run import cli, devices, files, missions, output, rundir
from jaxsense.run.compilation import Compiler
from jaxsense.run.devices import MAX_DEVICES
from jaxsense.run.monitor import Monitor
from jaxsense.run.output import say
from jaxsense.run.programs import OwnPolicies
from jaxsense.run.settings import MAX_SEED
from jaxsense.show import drawing, film, page, plots
from jaxsense.show.terminal import Display
from jaxsense.summary import blocks, compare, make, tables
from jaxsense.summary.blocks import policies as policies_of
from jaxsense.summary.read import EVALUATIONS, read_evaluations, read_summary

PROGRAM = "jaxsense.evaluate"


class ArenaArguments(Checked, place="arena"):
    """An arena that may differ from the run's.

    Attributes:
      num_pois: Number of points of interest; the run's by default.
      side: Side of the arena, in metres; the run's by default.
    """

    num_pois: int | None = None
    side: float | None = None


class Arguments(Checked):
    """Plays missions with the policies of a finished run, and compares them in the same arenas.

    Attributes:
      run: The directory of a finished run, e.g. `runs/20261123-190025-default`, or `latest` for the
        newest one in `runs/`.
      episodes: Number of missions per policy.
      seed: Seed of the arenas and of all noise, from 0 to 2^32 - 1.
      policy: What to play: `latent`, `greedy`, `bayes`, `optimal`, `naive`, `naive_2`,
        `naive_3`, `random`, `nearest`, `auction` or `rollout`; `policies` for all of these;
        `ROBOT_alone`, `ROBOT_stops` or `ROBOT_blind`, such as `camera_alone`, for the latent policy
        in missions where that robot works alone, or stops or goes blind after 6 s; or `all` for
        everything.
      robots: Sensors of the robots, one per robot, for example `camera camera lidar`; the run's by
        default.
      devices: Number of accelerators, or of CPU threads, that share the missions. By default all
        accelerators, or one thread per core, at most 8.
      cache: Directory in which to cache compiled programs; `none` for no cache.
      animate: Also write an animation of the first mission, `mission-POLICY-SEED.svg`.
      trust: Trust the run's `config.json`: run the code of custom sensors that it names.
    """

    run: Positional[Path]
    episodes: int = limited(256, at_least=1, at_most=MAX_EPISODES)
    seed: int = limited(0, at_least=0, at_most=MAX_SEED)
    policy: str = "all"
    arena: ArenaArguments = ArenaArguments()
    robots: tuple[str, ...] | None = None
    devices: int | None = limited(None, at_least=1, at_most=MAX_DEVICES)
    cache: Path | None = cli.CACHE
    animate: bool = False
    trust: bool = False


def main(argv: list[str] | None = None, policies: OwnPolicies | None = None) -> None:
    """Runs the program.

    Args:
      argv: the command line without the program; by default the process's own.
      policies: custom policies by name, to play in addition to `dqn.POLICIES`.
    """
    arguments = cli.parse(PROGRAM, Arguments, argv)
    display = Display()
    with cli.ending(PROGRAM):
        arguments = dataclasses.replace(arguments, run=rundir.newest(arguments.run))
        workers = devices.start(arguments.devices)
        trained, models = rundir.load(arguments.run, arguments.trust)
        config = _elsewhere(arguments, trained, models.agent.plays)
        scenario = mission.make_mission(config, policies)
        played = _cases(arguments, scenario)
        scenario = scenario.playing(case.policy for case in played.values())
        kept = cli.keep_programs(PROGRAM, arguments.cache, config, has_own_code=bool(policies))
        # If these files cannot be written, fail now rather than after minutes of work.
        with files.locked(arguments.run, on_wait=say):
            _report(arguments.run, trained)
            (arguments.run / EVALUATIONS).mkdir(exist_ok=True)
        number = arguments.episodes * len(played)
        monitor, key = Monitor(display.show), jax.random.key(arguments.seed)
        with display, Compiler(monitor, kept) as compiler:
            player = missions.Player(scenario, compiler, number, workers)
            found = player.play(key, models, played, arguments.episodes)
        block, written = make.missions(config, found.metrics), []
        if arguments.animate:
            (name, recording), *_ = found.recordings.items()
            title = f"{name} policy, seed {arguments.seed}"
            (text,) = film.draw(config, {title: recording}, models.fusion)
            elsewhere = "" if config == trained else f"-{_place(config)}"
            path = arguments.run / f"mission-{name}-{arguments.seed}{elsewhere}.svg"
            files.write(path, text)
            written.append(f"The first mission of {name} is in {path}.")
        written.append(_write(arguments, trained, config, block))
    _print(block, arguments.episodes)
    timing = monitor.timing()
    seconds = timing["stages"]["mission"]["run_s"]
    compiling = timing["total_s"] - seconds
    say(f"{number} missions in {seconds:.1f} s after {compiling:.0f} s of compilation")
    for line in written:
        say(line)


def _write(arguments: Arguments, trained: Config, config: Config, missions: blocks.Missions) -> str:
    """Writes an evaluation and the run's page; returns a line about them."""
    run, origin = arguments.run, rundir.origin()
    for case in missions.values():
        case["seed"] = arguments.seed
    stem = f"{_place(config)}-seed-{arguments.seed}-{arguments.episodes}-missions"
    with files.locked(run, on_wait=say):
        # Another policy may have played in the same arenas before; by other code, it stands apart.
        others = read_evaluations(run)
        apart = {
            name: compare.differences_of([other.get("origin", compare.UNKNOWN), origin])
            for name, other in others.items()
        }
        names = [stem, *(f"{stem}-{n + 2}" for n in range(len(others)))]
        name = next(name for name in names if not apart.get(name))
        found: blocks.Evaluation = {
            "num_pois": config.arena.num_pois,
            "side": config.arena.side,
            "robots": list(config.carried),
            "origin": origin,
            "mission": {**(others[name]["mission"] if name in others else {}), **missions},
        }
        path = run / EVALUATIONS / f"{name}.json"
        rundir.write_json(path, found)
        # Robots that are alone or fail are not drawn.
        if policies_of(found["mission"]):
            plot = plots.policies(found["mission"])
            files.write(path.with_suffix(".svg"), drawing.svg(plot))
        report = _report(run, trained)
    return f"The metrics are in {path}, and with all others in {report}."


def _report(run: Path, config: Config) -> Path:
    """Writes the page of a run; raises `ConfigError` if its figures are wrong."""
    own, found, path = read_summary(run), read_evaluations(run), run / "report.html"
    if own.get("seeds"):
        raise ConfigError("run", str(run), "holds several seeds; choose one")
    files.write(path, page.render(run, config, own, found))
    return path


def _place(config: Config) -> str:
    """Short name of an arena and its robots, for file names."""
    robots = tables.counted(config.carried).replace(", ", "-").replace(" ", "-")
    return f"{config.arena.num_pois}-points-{config.arena.side:g}-m-{robots}"


def _elsewhere(arguments: Arguments, config: Config, plays: Callable[[int], bool]) -> Config:
    """The run's settings with the arena and the team of these missions."""
    changed = {name: x for name, x in vars(arguments.arena).items() if x is not None}
    arena = dataclasses.replace(config.arena, **changed)
    # The Q-network of one agent has an input for each PoI.
    if not plays(arena.num_pois):
        reason = f"must be {config.arena.num_pois}, as in training; others need dqn.task = team"
        raise ConfigError("arena.num_pois", arena.num_pois, reason)
    robots, given = config.robots, arguments.robots
    if given is not None and sorted(given) != sorted(config.carried):
        # In one order, so that a team plays in the same arenas however it is named.
        robots = tuple(sorted(given, key=[*config.modalities, *given].index))
    # No mission starts with a map that is partly seen, which limits the number of PoIs.
    is_partly_seen = config.mdp.partly_seen_starts and arena == config.arena
    mdp = dataclasses.replace(config.mdp, partly_seen_starts=is_partly_seen)
    there = dataclasses.replace(config, arena=arena, robots=robots, mdp=mdp)
    for what in looks.beyond_training(there):
        cli.warn(PROGRAM, what)
    return there


def _cases(arguments: Arguments, scenario: mission.Mission) -> dict[str, mission.Case]:
    """The cases to play; raises `ConfigError` for an unknown policy."""
    cases = mission.cases(scenario.config, scenario.policies)
    known = {"all": cases, "policies": {name: cases[name] for name in scenario.policies}}
    known |= {name: {name: case} for name, case in cases.items()}
    require_known("policy", arguments.policy, known)
    return known[arguments.policy]


def _print(missions: blocks.Missions, episodes: int) -> None:
    """Prints the metrics of all cases."""
    caption = f"{episodes} missions of each policy, in the same arenas"
    for table in (tables.missions(missions, caption), tables.failures(missions)):
        if table.rows:
            say(str(table))
    if verdict := compare.verdict(missions):
        say(verdict)


if __name__ == "__main__":
    output.run(main)
