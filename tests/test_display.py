"""What a run shows, on a terminal and elsewhere."""

import io
import re

import pytest
import rich.console

from jaxsense.show.terminal import Display


def show(display):
    with display:
        display.show("dqn", 0, 0, {})
        display.show("dqn_camera", 100, 800, {"loss": 0.5, "reward": 1.0})
        display.show("dqn_camera", 200, 800, {"loss": 0.25, "reward": 1.0})


@pytest.mark.parametrize("width", [80, 120])
def test_a_terminal_shows_count_time_left_and_metrics_at_any_width(width):
    text = io.StringIO()
    show(Display(rich.console.Console(file=text, force_terminal=True, width=width)))
    shown = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", text.getvalue())
    last = [line for line in shown.splitlines() if line.startswith("dqn_camera")][-1]
    assert re.search(r"200/800 +\S+ +loss 0.25", last)
    assert "━" in last


@pytest.mark.parametrize("is_quiet", [False, True])
def test_without_a_terminal_there_are_plain_lines_now_and_then(capsys, is_quiet):
    records, console = [], rich.console.Console(file=io.StringIO())
    show(Display(console, [lambda **figures: records.append(figures)], is_quiet))
    lines = capsys.readouterr().out.splitlines()
    expected = ["dqn: compiling", "dqn_camera: 100 of 800  loss 0.5  reward 1"]
    told = [re.sub(r"^ *[\d.]+ s  ", "", line) for line in lines]
    assert told == ([] if is_quiet else expected)
    assert records[1] == {"stage": "dqn_camera", "step": 200, "loss": 0.25, "reward": 1.0}
