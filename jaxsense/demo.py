"""`jaxsense demo`: plays a mission with trained robots and opens a page with its animations."""

import os
import sys
import webbrowser
from pathlib import Path

import jax

from jaxsense import mission
from jaxsense.config.options import command
from jaxsense.config.section import Checked, limited
from jaxsense.run import cli, devices, files, missions, output, rundir
from jaxsense.run.compilation import Compiler
from jaxsense.run.monitor import Monitor
from jaxsense.run.output import say
from jaxsense.run.settings import MAX_SEED
from jaxsense.show import film, page
from jaxsense.show.terminal import Display
from jaxsense.summary import make, tables
from jaxsense.tasks import PRETRAINED, load_pretrained

PROGRAM = "jaxsense.demo"
_REFERENCE = "naive"
_AVERAGES = "What learning is worth"  # section of the README


class Arguments(Checked):
    """Plays a mission with trained robots and again with naive exploration, and shows both.

    Attributes:
      preset: Preset with which the robots were trained: `default`, `noisy`, `many`, `raw` or
        `team`.
      policy: Policy to compare with naive exploration: `latent` (the learned policy),
        `greedy`, `bayes`, `optimal`, `naive_2`, `naive_3`, `random`, `nearest`, `auction` or
        `rollout`.
      seed: Seed of the arena and of all noise, from 0 to 2^32 - 1. In the arenas of seeds 2 and 3,
        robots can skip looks; in those of 0 and 1, they cannot.
      out: Directory for the page, new or empty; by default `runs/DATE-TIME-demo-PRESET`.
      browser: Open the page in a browser, if there is a display.
      cache: Directory in which to cache compiled programs; `none` for no cache.
    """

    preset: str = "default"
    policy: str = "latent"
    seed: int = limited(2, at_least=0, at_most=MAX_SEED)
    out: Path | None = None
    browser: bool = True
    cache: Path | None = cli.CACHE


def main(argv: list[str] | None = None) -> None:
    """Runs the program.

    Args:
      argv: the command line without the program; by default the process's own.
    """
    arguments = cli.parse(PROGRAM, Arguments, argv)
    with cli.ending(PROGRAM):
        devices.start(1)
        config, models = load_pretrained(arguments.preset)
        scenario, cases = mission.make_mission(config), mission.cases(config)
        scenario.policy(arguments.policy)
        played = {name: cases[name] for name in (arguments.policy, _REFERENCE)}
        scenario = scenario.playing(played)
        kept = cli.keep_programs(PROGRAM, arguments.cache, config)
        # Before a minute of work.
        with rundir.begun(arguments.out, f"demo-{arguments.preset}") as place:
            with Display() as display, Compiler(Monitor(display.show), kept) as compiler:
                player = missions.Player(scenario, compiler, len(played))
                found = player.play(jax.random.key(arguments.seed), models, played, episodes=1)
            recordings = {f"{name} policy": each for name, each in found.recordings.items()}
            films = film.draw(config, recordings, models.fusion)
            block = make.missions(config, found.metrics)
            table = tables.missions(block, "One mission of each policy, in the same arena")
            path = place / "demo.html"
            text = page.fill(
                "demo.html.jinja",
                preset=arguments.preset,
                policy=arguments.policy,
                seed=arguments.seed,
                other=next(name for name in PRETRAINED if name != arguments.preset),
                films=[dict(zip(recordings, map(page.drawing, films), strict=True))],
                averages=_AVERAGES,
                table=table,
            )
            files.write(path, text)
    say(str(table))
    say(f"This is one mission of many; averages: README, {_AVERAGES}.")
    say(f"The page is {path}.")
    say(f"Next: {command('jaxsense tasks')}")
    if arguments.browser and _has_display():
        webbrowser.open_new_tab(path.resolve().as_uri())


def _has_display() -> bool:
    """Whether a browser could open a window; without one it would take over the terminal."""
    names = "DISPLAY", "WAYLAND_DISPLAY"
    return sys.platform == "darwin" or any(os.environ.get(name) for name in names)


if __name__ == "__main__":
    output.run(main)
