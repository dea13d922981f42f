"""Command lines at random: each is read, or ends with status 2 and one line."""

import random

import pytest

from jaxsense import PRESETS, demo, evaluate, explore, export, task_list, train
from jaxsense.config import options
from jaxsense.run import cli
from jaxsense.run.settings import Settings

SEED, LINES = 20261129, 6_000
DEFAULT = train.Arguments(Settings(config=PRESETS["smoke"]))
PARSE = {"train": (train.parse, DEFAULT)} | {
    module.PROGRAM: (
        lambda argv, module=module: cli.parse(module.PROGRAM, module.Arguments, argv),
        module.Arguments,
    )
    for module in (evaluate, explore, export, demo, task_list)
}
"""How each command reads a command line, and the dataclass of its options."""
# `--help` and paths that exist would do something.
WORDS = [
    "", " ", "-", "--", "---", "--=", "=", "==", "-1", "-x", "-0", "0", "1", "3", "256", "1e3",
    "1e999", "-inf", "nan", "NaN", "0x10", "1_000", "1.5", "١٢", "9" * 5_000, "1" + "0" * 400,
    "none", "None", "null", "true", "False", "[]", "{}", "()", "[1, 2]", "(1,)", "{'a': 1}",
    "[" * 500, "a b", "a,b", "a=b", "--a=b", "\0", "\n", "\x1b[31m", "\ud800", "é", "日本", "🤖",
    "\u202e", "%s", "%(prog)s", "{}", "*", "~", "$HOME", "camera", "lidar", "camera lidar",
    "smoke", "default", "latest", "latent", "map", "team", "in_place", "no/such/path",
    "file:///x", "@options", "--no-", "--dqn", "--dqn.", "--dqn..epochs", "--.",
    "--mission.localisation", "--help-", "--arena.classes.red",
]  # fmt: skip


def line_of(draw, names):
    """Up to six words, most of them options or values after them."""
    words = []
    for _ in range(draw.randint(0, 6)):
        name, value = draw.choice(names), draw.choice(WORDS)
        if draw.random() < 0.1:
            at = draw.randint(0, len(name))
            name = name[:at] + draw.choice(["", "_", "-", ".", "=", "x", "é"]) + name[at + 1 :]
        words += draw.choice([[name], [value], [f"{name}={value}"], *[[name, value]] * 2])
        if draw.random() < 0.1:
            words += draw.choices(WORDS, k=draw.randint(1, 4))
    return words


def status_of(parse, argv):
    """The status with which a command line ends its program; None if it is read."""
    try:
        parse(argv)
    except SystemExit as stop:
        return stop.code
    except BaseException as error:
        raise AssertionError(argv) from error


@pytest.mark.parametrize("lines", [200, pytest.param(LINES, marks=pytest.mark.slow)])
@pytest.mark.parametrize("command", PARSE)
def test_any_command_line_is_read_or_refused_in_one_line(
    command, lines, capsys, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    draw = random.Random(f"{SEED} {command}")
    parse, base = PARSE[command]
    known = [option for option in options.options_of(base) if option.name.startswith("-")]
    names = [option.name for option in known] or ["--seed"]
    names += [f"--no-{option.name[2:]}" for option in known if option.kind is bool]
    read = 0
    for _ in range(lines // len(PARSE)):
        argv = line_of(draw, names)
        status = status_of(parse, argv)
        told = capsys.readouterr()
        assert told.out == "", argv
        if status is None:
            assert told.err == "", argv
            read += 1
        else:
            assert status == 2, argv
            assert told.err.endswith("\n"), argv
            assert told.err[:-1].isprintable(), argv
            assert len(told.err) < 1_000, argv
    assert 0 < read < lines
    assert not any(tmp_path.iterdir())
