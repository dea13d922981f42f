"""Settings as options: what a command line sets, and the help that describes them."""

import dataclasses
import re
from pathlib import Path
from typing import Literal

import pytest

from jaxsense import train
from jaxsense.config import PRESETS, ConfigError, Shape, options, presets
from jaxsense.config.options import Positional
from jaxsense.run.rundir import RunDirectory, Settings


@dataclasses.dataclass(frozen=True)
class Sail:
    """A sail of `canvas`.

    Attributes:
      area: Its area, in square metres.
      corners: Numbers of its corners.
    """

    PLACE = "sail"
    area: float = 2.5
    corners: tuple[int, ...] = (1, 2)


@dataclasses.dataclass(frozen=True)
class Ship:
    """A ship with two sails and a long description.

    Attributes:
      port: The port to leave.
      stops: Other ports.
      size: Length and width.
      holes: Number of leaks.
      kind: What it is.
      log: Its log book.
      crew: Number of people, if it is known.
      engine: Whether to use the engine.
      night: Whether to sail at night.
    """

    port: Positional[str]
    stops: Positional[tuple[str, ...]] = ()
    sail: Sail = dataclasses.field(default=Sail())
    size: tuple[int, int] = (3, 1)
    holes: int = 0
    kind: Literal["brig", "yawl"] = "brig"
    log: Path | None = None
    crew: int | None = None
    engine: bool = True
    night: bool = False


USAGE = """usage: python -m jaxsense.sail [OPTIONS] PORT [STOPS ...]

A ship with two sails and a long
description.
"""
CREW = """  --crew INT
      Number of people, if it is known.
"""
SAIL = """sail:
  A sail of canvas.

  --sail.area NUMBER
      Its area, in square metres.
      (default: 2.5)
"""
HELP = f"""{USAGE}
options:
  PORT
      The port to leave.
  STOPS
      Other ports.
  --size INT INT
      Length and width. (default: 3 1)
  --holes INT
      Number of leaks. (default: 0)
  --kind {{brig,yawl}}
      What it is. (default: brig)
  --log PATH
      Its log book.
{CREW}  --engine, --no-engine
      Whether to use the engine.
      (default: on)
  --night, --no-night
      Whether to sail at night.

{SAIL}  --sail.corners [INT ...]
      Numbers of its corners. (default:
      1 2)
"""
SHORT = f"{USAGE}\noptions:\n{CREW}\n{SAIL}\n--help-all lists all 11 options.\n"


def test_the_help_describes_all_options_by_section_or_some(monkeypatch):
    monkeypatch.setenv("COLUMNS", "42")
    assert options.describe("jaxsense.sail", Ship) == HELP
    assert options.describe("jaxsense.sail", Ship, ["--crew", "--sail.area"]) == SHORT
    monkeypatch.setattr("sys.argv", ["/bin/jaxsense"])
    assert options.describe("jaxsense.sail", Ship).startswith("usage: jaxsense sail [OPTIONS]")


@pytest.mark.parametrize(
    ("line", "changes"),
    [
        ("Rome", {}),
        ("Rome Oslo Kiel --crew 3", {"stops": ("Oslo", "Kiel"), "crew": 3}),
        ("--crew=3 Rome --crew None --log=a/b", {"log": Path("a/b")}),
        ("Rome --no-engine --night --size 4 -2", {"engine": False, "night": True, "size": (4, -2)}),
        ("Rome --sail.area -.5", {"sail": Sail(-0.5)}),
        ("Rome --sail.corners", {"sail": Sail(corners=())}),
        (
            "Rome --kind yawl --sail.corners 7 8 9",
            {"kind": "yawl", "sail": Sail(corners=(7, 8, 9))},
        ),
        ("Rome --crew x", {"crew": "x"}),  # which a checked dataclass refuses
    ],
)
def test_words_are_read_in_the_types_of_the_fields(line, changes):
    assert options.read(Ship, line.split()) == dataclasses.replace(Ship("Rome"), **changes)


@pytest.mark.parametrize(
    ("line", "told"),
    [
        ("", "option = 'PORT': is missing: The port to leave."),
        ("Rome --size 4", "option = '--size': expected 2 arguments"),
        ("Rome --crew", "option = '--crew': expected one argument"),
        ("Rome --night=1", "option = '--night/--no-night': ignored explicit argument '1'"),
        ("Rome --crwe 3", "option = '--crwe': is unknown; did you mean --crew?"),
        ("Rome --sail.are 3", "option = '--sail.are': is unknown; did you mean --sail.area?"),
        (f"Rome --{300 * 'x'}", f"{197 * 'x'}...: is unknown; see --help-all"),
        (f"Rome --night={300 * 'x'}", f"ignored explicit argument '{73 * 'x'}"),
    ],
)
def test_a_line_that_cannot_be_read_is_told(line, told):
    with pytest.raises(ConfigError, match=re.escape(told)):
        options.read(Ship, line.split())


def test_all_help_explains_every_field(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    with pytest.raises(SystemExit) as stop:
        train.main(["--help-all"])
    assert stop.value.code == 0
    text = capsys.readouterr().out
    assert max(map(len, text.splitlines())) <= 80
    options = re.findall(r"^  (--\S+)", text, re.MULTILINE)
    assert {"--process-index", "--arena.side", "--dqn.epsilon-decay"} <= set(options)
    # Each option has a text.
    assert not re.search(r"^  --.*\n(?!      \S)", text, re.MULTILINE)


def test_every_kind_of_option_is_read(tmp_path):
    words = """--preset smoke --arena.side 4 --arena.num_pois=4 --mdp.partly-seen-starts
        --arena.colours.red 1 0 .5 --arena.shapes.cube.half-sides .5 .5
        --team.second-cost .3 --robots camera camera lidar --cache NONE --quiet --no-quiet
        --devices none --dqn.hidden 8 --dqn.observe live --seed 3 --seed 4"""
    arguments = train.parse(words.split())
    config, smoke = arguments.settings.config, PRESETS["smoke"]
    assert (arguments.settings.seed, arguments.cache, arguments.devices) == (4, None, None)
    assert arguments.quiet is False
    assert (config.arena.side, config.arena.num_pois) == (4.0, 4)
    assert config.arena.colours == {**smoke.arena.colours, "red": (1.0, 0.0, 0.5)}
    assert config.arena.shapes == {**smoke.arena.shapes, "cube": Shape("box", (0.5, 0.5))}
    assert config.mdp.partly_seen_starts is True
    assert config.team == dataclasses.replace(smoke.team, second_cost=0.3)
    assert config.robots == ("camera", "camera", "lidar")
    assert config.dqn == dataclasses.replace(smoke.dqn, hidden=(8,), observe="live")
    # Of a stored run, of which other options change settings; then without an option's value.
    with RunDirectory.create(tmp_path / "run", Settings("smoke", 7, config)):
        file = str(tmp_path / "run" / "config.json")
        again = train.parse(["--config", file, "--robots", "None", "--arena.side", "5"])
        resumed = train.parse(["--resume", str(tmp_path / "run")])
    given = again.settings
    assert (given.seed, given.preset, given.config.robots) == (7, "smoke", None)
    assert given.config.arena == dataclasses.replace(config.arena, side=5.0)
    assert resumed.settings == Settings("smoke", 7, config)
    # A preset's file, as a user may copy it, changes the preset that it names.
    file = str(Path(presets.__file__).parent / "many.toml")
    copied = train.parse(["--config", file, "--seed", "3"])
    assert copied.settings == Settings("noisy", 3, PRESETS["many"])
