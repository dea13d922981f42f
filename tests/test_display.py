"""What a run shows, on a terminal and elsewhere."""

import io
import re

import pytest
import rich.console

from jaxsense.show.tables import Table
from jaxsense.show.terminal import Display, as_text


def show(display):
    with display:
        display.show("dqn", 0, 0, {})
        display.show("dqn_camera", 100, 800, {"loss": 0.5, "reward": 1.0})
        display.show("dqn_camera", 200, 800, {"loss": 0.25, "reward": 1.0})


@pytest.mark.parametrize("width", [80, 120])
def test_a_terminal_shows_count_rate_and_time_left_at_any_width(width):
    text = io.StringIO()
    console = rich.console.Console(file=text, force_terminal=True, width=width)
    show(Display(console))
    shown = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", text.getvalue())
    last = [line for line in shown.splitlines() if line.startswith("dqn_camera")][-1]
    assert re.search(r"200/800 +\d+/s +\d+ s left +loss 0.25", last)
    assert ("━" in last) == (width == 120)


def test_without_a_terminal_there_are_plain_lines_now_and_then(capsys):
    records = []
    display = Display(
        rich.console.Console(file=io.StringIO()), [lambda **figures: records.append(figures)]
    )
    show(display)
    lines = capsys.readouterr().out.splitlines()
    assert [re.sub(r"^ *[\d.]+ s  ", "", line) for line in lines] == [
        "dqn: compiling",
        "dqn_camera: 100 of 800  loss 0.5  reward 1",
    ]
    assert [record["step"] for record in records] == [100, 200]


def test_a_quiet_display_records_and_shows_nothing(capsys):
    records = []
    console = rich.console.Console(file=io.StringIO(), quiet=True)
    show(Display(console, [lambda **figures: records.append(figures)], quiet=True))
    assert capsys.readouterr().out == ""
    assert records[1] == {"stage": "dqn_camera", "step": 200, "loss": 0.25, "reward": 1.0}


def test_a_table_is_not_cut_without_a_terminal():
    table = Table("caption", [f"column {n} " + "x" * 20 for n in range(9)], [("row", ["1"] * 9)])
    text = as_text(rich.console.Console(file=io.StringIO(), width=80), table)
    assert all(name in text for name in table.columns)
    narrow = rich.console.Console(file=io.StringIO(), width=80, force_terminal=True)
    assert not any(name in as_text(narrow, table) for name in table.columns)


def test_the_note_of_a_table_stands_below_it():
    table = Table("caption", ["column"], [("row", ["1"])], note="why [x] " + "y" * 90)
    *_, last = as_text(rich.console.Console(file=io.StringIO(), width=80), table).splitlines()
    assert last == table.note
