"""Tables of a run, and what it shows meanwhile, on a terminal and elsewhere."""

import io
import re

import pytest
import rich.console
from summaries import CASE, SUMMARY

from jaxsense.show.terminal import Display
from jaxsense.summary import tables
from jaxsense.summary.blocks import MISSIONS


def test_missions_that_no_robot_ended_are_told():
    naive = {**CASE, "ended": {"time limit": 1, "undetected": 2}}
    table = tables.missions(dict(latent=CASE, naive=naive), "")
    assert table.rows[1][1][-1] == "1\u00a0time\u00a0limit, 2\u00a0undetected"
    assert "unfinished" in table.meanings


def test_every_metric_of_missions_is_shown_for_who_has_it():
    alone = {**CASE, "told": 0.75, "ambiguous_reported": None, "seed": 7}
    first, calibration = tables.all_of_missions(dict(latent=CASE, camera_alone=alone))
    absent = ("intervals.", "goals_reached", "ambiguous", "seed", "ended")
    expected = {m.label for key, m in MISSIONS.items() if not key.startswith(absent)}
    assert {*first.columns, *calibration.columns} == expected
    assert [texts[first.columns.index("right labels")] for _, texts in first.rows] == ["-", "0.750"]


def test_figures_stand_in_tables():
    rows = dict(tables.detectors(SUMMARY).rows)
    assert rows["camera"] == ["0.9995", "0.0100", "0.0200"]
    of_agent = ["1.234", "1.250", "1.240", "1.000", "-1.500", "0.988", "1,700", "1,728"]
    assert dict(tables.agents(SUMMARY).rows)["lidar"] == of_agent
    here = ["2", "0.007", "0.0001", "0.9996", "0.021", "0.030", "0.938"]
    assert tables.latent_space(SUMMARY).rows == [("here", here)]
    # Camera, LiDAR, both; in brackets the looks after which just the right classes are plausible,
    # and the norm of sigma.
    red = ["no (100.0%, 1.25)", "yes (100.0%, 1.25)", "yes (100.0%, 1.25)"]
    classes = "green cylinder", "red cylinder", "red cube"
    assert dict(tables.unambiguous(SUMMARY, classes).rows)["red cylinder"] == red
    assert tables.times(SUMMARY, SUMMARY["timing"])[0].rows == [("jmvae", ["1.50", "4.50"])]


def test_columns_are_aligned():
    table = tables.Table("Both", ["a", "long"], [("one", ["1.5", "2"]), ("second", ["10", "[b]"])])
    assert str(table).splitlines() == [
        "Both",
        "          a  long",
        "one     1.5     2",
        "second   10   [b]",
    ]


def show(display):
    with display:
        display.show("dqn", 0, 0, {})
        display.show("dqn_camera", 100, 800, {"loss": 0.5, "reward": 1.0})
        display.show("dqn_camera", 200, 800, {"loss": 0.25, "reward": 1.0})


@pytest.mark.parametrize("width", [80, 120])
def test_a_terminal_shows_count_time_left_and_metrics_at_any_width(width):
    text = io.StringIO()
    console = rich.console.Console(file=text, force_terminal=True, width=width)
    show(Display(console=console))
    shown = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", text.getvalue())
    last = [line for line in shown.splitlines() if line.startswith("dqn_camera")][-1]
    assert re.search(r"200/800 +\S+ +loss 0.25", last)
    assert "━" in last


@pytest.mark.parametrize("is_quiet", [False, True])
def test_without_a_terminal_there_are_plain_lines_now_and_then(capsys, is_quiet):
    records, console = [], rich.console.Console(file=io.StringIO())
    show(Display([lambda **figures: records.append(figures)], is_quiet, console))
    lines = capsys.readouterr().out.splitlines()
    expected = ["dqn: compiling", "dqn_camera: 100 of 800  loss 0.5  reward 1"]
    told = [re.sub(r"^ *[\d.]+ s  ", "", line) for line in lines]
    assert told == ([] if is_quiet else expected)
    assert records[1] == {"stage": "dqn_camera", "step": 200, "loss": 0.25, "reward": 1.0}
