"""Robots that are misplaced or hear badly: break points by hand, and what the sweeps change."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from benchmarks import imperfect, imperfect_tables
from jaxsense import PRESETS
from jaxsense.config import ConfigError, SearchConfig

ARGUMENTS = imperfect.Arguments(run=Path("latest"))
MODELS: Any = SimpleNamespace(agent=SimpleNamespace(plays=lambda number: number in (3, 16)))


def lost(*means):
    """Losses of accuracy that are the same in ten arenas."""
    return np.repeat(np.array(means)[:, None], 10, axis=1)


def test_break_points_lie_between_two_sizes():
    # From 0 at size 0 to .02 at size 1: half way.
    assert imperfect.break_point((1.0, 2.0), lost(0.02, 0.1)) == pytest.approx(
        {"mean": 0.5, "low": 0.5, "high": 0.5}
    )
    # From .004 at 1 to .012 at 3, .006 of .008: 1 + .75 x 2.
    found = imperfect.break_point((1.0, 3.0), lost(0.004, 0.012))
    assert found is not None
    assert found["mean"] == pytest.approx(2.5)
    # The accuracy may rise at first.
    found = imperfect.break_point((1.0, 2.0), lost(-0.01, 0.03))
    assert found is not None
    assert found["mean"] == pytest.approx(1.5)
    assert imperfect.break_point((1.0, 2.0), lost(0.002, 0.009)) is None


def test_break_points_have_intervals_of_arenas():
    # A tenth of the arenas loses .15, the others nothing; a bootstrap that misses it never breaks.
    each = np.zeros((1, 10))
    each[0, 0] = 0.15
    found = imperfect.break_point((1.0,), each)
    assert found is not None
    assert found["mean"] == pytest.approx(2 / 3)
    assert found["low"] is not None
    assert found["low"] < 0.3
    assert found["high"] is None


def test_sweeps_change_one_thing_or_two():
    expected = {  # of the third size: constant errors of position and heading, then their drifts
        "position [m]": (0.03, 0.0, 0.0, 0.0),
        "heading [deg]": (0.0, 3.0, 0.0, 0.0),
        "both [m]": (0.03, 3.0, 0.0, 0.0),
        "position drift [m]": (0.0, 0.0, 0.02, 0.0),
        "heading drift [deg]": (0.0, 0.0, 0.0, 2.0),
        "both drifts [m]": (0.0, 0.0, 0.02, 2.0),
    }
    found = {}
    for sweep in imperfect.poses(ARGUMENTS, SearchConfig()):
        errors = imperfect.changed(PRESETS["noisy"], sweep.changes[2]).mission.localisation
        constant = errors.position_error, errors.heading_error
        found[sweep.name] = (*constant, errors.position_drift, errors.heading_drift)
        assert len(sweep.sizes) == len(sweep.changes)
        assert sweep.sizes[2] in found[sweep.name]
    assert found == expected
    for sweep in imperfect.messages(ARGUMENTS):
        assert len(sweep.sizes) == len(sweep.changes)
        for size, change in zip(sweep.sizes, sweep.changes, strict=True):
            told = imperfect.changed(PRESETS["noisy"], change).mission.communication
            expected = {
                "loss": (size, 0.0),
                "delay [s]": (0.0, size),
                "loss, delay 2 s": (size, 2.0),
                "delay [s], loss 0.5": (0.5, size),
            }[sweep.name]
            assert told.own_maps
            assert (told.loss, told.delay) == expected


def test_misplaced_robots_may_search():
    given = imperfect.Arguments(run=Path("latest"), search_position=0.09, search_heading=6.0)
    for sweep in imperfect.poses(given, given.search):
        for changes in sweep.changes:
            searched = imperfect.changed(PRESETS["noisy"], changes).mission.localisation.search
            assert (searched.position, searched.heading) == (0.09, 6.0)
    with pytest.raises(ConfigError, match=r"search.heading = 31"):
        imperfect.Arguments(run=Path("latest"), search_heading=31.0)


def test_other_arenas_and_robots():
    four = imperfect.Arguments(
        run=Path("latest"), num_pois=16, side=6.0, robots=("camera", "lidar") * 2
    )
    config = imperfect.elsewhere(four, PRESETS["team"], MODELS)
    assert (config.arena.num_pois, config.arena.side, len(config.carried)) == (16, 6.0, 4)
    assert imperfect.elsewhere(ARGUMENTS, PRESETS["default"], MODELS) == PRESETS["default"]
    with pytest.raises(ConfigError, match="num_pois = 8: must be a number that the run"):
        imperfect.elsewhere(ARGUMENTS, PRESETS["team"], MODELS)
    with pytest.raises(ConfigError, match=r"headings .*: must be as many as positions"):
        imperfect.Arguments(run=Path("latest"), headings=(1.0,))
    with pytest.raises(ConfigError, match=r"heading_drifts .*: must be as many as position_drifts"):
        imperfect.Arguments(run=Path("latest"), heading_drifts=(1.0,))


ORIGIN = {
    "command": "python -m benchmarks.imperfect pretrained:noisy", "device": "cpu", "cores": 2,
    "commit": "0123456789abcdef", "date": "2026-11-26", "versions": {"jax": "0.10.2"},
}  # fmt: skip
USUAL = {"accuracy": 0.99, "own": 0.99, "nll": 0.05, "looks": 2.5, "time": 40.0}


def sweep(name, *sizes, accuracy=0.98, point=None):
    """Rows whose figures differ from those without errors by the same at all sizes."""
    figures = {key: [mean, 0.5, 0.25] for key, mean in {**USUAL, "accuracy": accuracy}.items()}
    return {"sweep": name, "rows": [{"size": x, **figures} for x in sizes], "break": point}


POINT = {"mean": 0.005, "low": 0.004, "high": None}
RESULTS = {
    **ORIGIN,
    "usual": USUAL,
    "curves": {
        "no search": [sweep("both [m]", 0.01, 0.02, point=POINT)],
        "with a search": [sweep("both [m]", 0.01, 0.02, accuracy=0.985)],
        "messages": [sweep("loss", 0.1, 0.9)],
    },
}


def test_break_points_stand_next_to_those_with_a_search():
    head, _, row, _, about = imperfect_tables.breaks(RESULTS).splitlines()
    assert head == "| error | no search | with a search |"
    assert row == "| both [m] | 0.005 (0.004 to ?) | - |"
    assert about.startswith("`python -m benchmarks.imperfect pretrained:noisy`: cpu with 2 cores;")


def test_sizes_are_compared_with_no_error():
    _, _, none, _, second, *_ = imperfect_tables.of_sizes(RESULTS, ["both [m]"]).splitlines()
    assert none == "| none | 0.990 | 2.50 | 40.0 | 0.990 | 2.50 | 40.0 |"
    assert second.startswith("| both [m]: 0.02 | 0.980, +0.500 ± 0.250 | 2.50, +0.50 ± 0.25 |")
    assert "| 0.985, +0.500 ± 0.250 |" in second
    alone = {**RESULTS, "curves": {"no search": RESULTS["curves"]["no search"]}}
    assert "with a search" not in imperfect_tables.of_sizes(alone, ["both [m]"])


def test_messages_are_shown_at_their_worst():
    _, _, shared, worst, *_ = imperfect_tables.of_messages(RESULTS).splitlines()
    assert shared == "| one shared map | 0.990 | 0.990 | 0.050 | 2.50 | 40.0 |  |"
    assert worst.startswith("| loss: 0.9 | 0.980, +0.500 ± 0.250 |")
    assert worst.endswith("| 1.000 |")
    assert len([*imperfect_tables.tables(RESULTS)]) == 3
