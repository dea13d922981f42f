"""`python -m benchmarks.film RUN --plot FILE`: animates one mission."""

import dataclasses
import sys
from pathlib import Path
from typing import Annotated

import jax
import rich.console

from benchmarks import measure, studies
from jaxsense import mission
from jaxsense.config import ConfigError
from jaxsense.config.checks import check_fields, require
from jaxsense.config.options import Name
from jaxsense.evaluate import ArenaArguments
from jaxsense.run import cli, devices, files, missions
from jaxsense.run.compilation import Compiler
from jaxsense.run.monitor import Monitor
from jaxsense.show import animation
from jaxsense.show.terminal import Display

PROGRAM = "benchmarks.film"


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Animates a mission of trained robots."""

    run: Annotated[Path, Name("RUN")]
    """The directory of a finished run, `latest`, or `pretrained:PRESET`."""
    plot: Path = Path("mission.svg")
    """Animation to write; must be new."""
    policy: str = "latent"
    """What decides where the robots look; the learned policy by default."""
    seed: int = 0
    """Seed of the arena and of all noise."""
    arena: ArenaArguments = ArenaArguments()  # noqa: RUF009 (frozen, in another file)
    robots: tuple[str, ...] | None = None
    """Sensors of the robots, one per robot; the run's by default."""

    def __post_init__(self):
        check_fields(self, bits=64)
        require(not self.plot.exists(), self, "plot", "must be a new file")


def main(argv: list[str] | None = None) -> None:
    """The program."""
    arguments = cli.parse(PROGRAM, Arguments, sys.argv[1:] if argv is None else argv)
    devices.start(1)
    config, models = studies.load(PROGRAM, arguments.run)
    sizes = dataclasses.asdict(arguments.arena)
    arena = {name: value for name, value in sizes.items() if value is not None}
    policy = arguments.policy
    title = f"{policy} policy"
    try:
        if arena or arguments.robots:
            config = dataclasses.replace(
                config,
                arena=dataclasses.replace(config.arena, **arena),
                robots=arguments.robots or config.robots,
                mdp=dataclasses.replace(config.mdp, partly_seen_starts=False),
            )
            title = f"{policy}, {config.arena.num_pois} PoIs, {len(config.carried)} robots"
        scenario = mission.make_mission(config)
    except ConfigError as error:
        cli.fail(PROGRAM, str(error))
    cases = mission.cases(config, scenario.policies)
    measure.require_known(PROGRAM, "policy", (policy,), cases)
    played = {policy: cases[policy]}
    with (
        Display(rich.console.Console()) as display,
        Compiler(Monitor(display.show), cli.keep_programs(PROGRAM, cli.CACHE, config)) as compiler,
    ):
        player = missions.Player(scenario, compiler, batch=1)
        recording = player.play(jax.random.key(arguments.seed), models, played, 1).recording
    film = animation.draw(
        config, recording.records, recording.end, models.fusion, scenario.fields_of_view, title
    )
    files.write(arguments.plot, film)


if __name__ == "__main__":
    main()
