"""The blocks of a summary, from made-up arrays."""

import numpy as np
import pytest
from summaries import FOUND

from jaxsense.config import PRESETS, Config, JmvaeConfig
from jaxsense.config.learning import EvaluationConfig
from jaxsense.config.scene import ArenaConfig
from jaxsense.summary import make

CONFIG = PRESETS["smoke"]
RETURNS = "return", "optimal", "greedy", "naive", "random", "fraction_of_optimal"


# Two PoIs of two classes and one sensor: 2^2 x 2^2 states, of which half hold both classes.
SMALL = Config(
    modalities=("camera",),
    arena=ArenaConfig(num_pois=2, classes=("green cylinder", "red cylinder")),
    jmvae=JmvaeConfig(reconstruction_weights=(1.0,)),
    evaluation=EvaluationConfig(num_starts=3, num_pois=(9,)),
)


def test_figures_of_policies_as_worked_by_hand():
    # Sixteen states and three random starts, of which the figures are means.
    names = "latent", "optimal", "naive", "random", "greedy"
    of_states = np.zeros((5, 16))
    # .02 and .009 below the optimum, of which .01 is let pass; more than the optimum is too. The
    # classes of the first and last four states are equal, of the others different.
    of_states[1, [0, 1, 4, 5, 10]] = 0.02, 0.009, 0.02, 0.009, 0.5
    of_states[0, 15] = 1.0
    of_starts = np.array(
        [[0.9, 1.0, 1.1], [1.0, 1.1, 1.2], [0.5, 0.5, 0.8], [-1.0, 0.0, -0.5], [1.0, 1.0, 1.3]]
    )
    total = np.concatenate([of_states, of_starts], axis=1)
    rewards = {name: (x, x / 2) for name, x in zip(names, total, strict=True)}
    figures = make.agent(SMALL, rewards, [2.0, 3.0], [rewards])
    expected = {"return": 1.0, "optimal": 1.1, "greedy": 1.1, "naive": 0.6, "random": -0.5}
    assert {name: figures[name] for name in expected} == pytest.approx(expected)
    assert figures["fraction_of_optimal"] == pytest.approx(1 / 1.1)
    assert figures["other_numbers"]["9"] == {name: figures[name] for name in RETURNS}
    assert figures["env_steps_per_s"] == figures["env_steps"] / 5
    one_step = {"policy": 0.5, "optimal": 0.55, "random": -0.25}
    assert figures["one_step"] == pytest.approx(one_step)
    assert (figures["optimal_states"], figures["num_states"]) == (13, 16)
    assert (figures["optimal_permutations"], figures["num_permutations"]) == (6, 8)
    without = make.agent(SMALL, rewards, [2.0, 3.0], has_optimum=False)
    ends = "optimal", "fraction_of_optimal", "optimal_states", "optimal_permutations"
    assert [without[end] for end in ends] == [None] * 4
    assert without["one_step"]["optimal"] is None
    assert without["return"] == figures["return"]
    # More than the optimum, of which .011 and two standard errors are let pass: .020, then .038.
    for more, is_null in (([0.02, 0.03, 0.04], True), ([0.0, 0.0, 0.05], False)):
        better = {**rewards, "greedy": (total[1] + np.append(np.zeros(16), more), total[1])}
        found = make.agent(SMALL, better, [1.0], [better])
        for block in (found, found["other_numbers"]["9"]):
            assert (block["optimal"] is None) is is_null
        assert (found["optimal_states"] is None) is is_null
    # Of other numbers of PoIs alone: only theirs has no optimum then.
    better = {**rewards, "greedy": (total[1] + 0.03, total[1])}
    found = make.agent(SMALL, rewards, [1.0], [better])
    assert found["optimal"] == pytest.approx(1.1)
    assert found["other_numbers"]["9"]["optimal"] is None
    # .010 more without an error is within a share of .01 of 1.1.
    better = {**rewards, "greedy": (total[1] + 0.010, total[1])}
    assert make.agent(SMALL, better, [1.0])["optimal"] == pytest.approx(1.1)
    none = dict.fromkeys(names, (np.zeros(19), np.zeros(19)))
    nothing = make.agent(SMALL, none, [1.0])
    assert "other_numbers" not in nothing
    assert nothing["fraction_of_optimal"] is None


def test_summary_of_a_case_as_worked_by_hand():
    block = make.case(CONFIG, "latent", FOUND)
    assert block == {
        "accuracy": pytest.approx(5 / 6),
        "observations_per_poi": 1.5,
        "time_s": 15.0,
        "mean_time_s": 15.0,
        "collisions": 2,
        "goals_reached_fraction": 0.9,
        "information": 5.5,
        # .76 = 3.8 / 5, four of five, and .42 = 2.1 / 5.
        "calibration": pytest.approx({"confidence": 0.76, "accuracy": 0.8, "nll": 0.42}),
        "episodes": 2,
        "ended": {"finished": 1, "time limit": 1},
    }
    both = make.case(CONFIG, "latent", {**FOUND, "reason": np.array([1, 1])})
    assert both["ended"] == {"finished": 2}
    # LiDAR alone cannot tell the two cylinders apart: classes 0 and 1, of which one of three is
    # reported as ambiguous.
    alone = make.case(CONFIG, "lidar_alone", FOUND)
    assert alone["told"] == pytest.approx(0.5)
    assert alone["ambiguous_reported"] == pytest.approx(1 / 3)
    # Nothing of nothing is no number.
    nothing = {**FOUND, "goals": np.zeros(2, int), "goals_reached": np.zeros(2, int)}
    assert make.case(CONFIG, "latent", nothing)["goals_reached_fraction"] is None
    unseen = make.case(CONFIG, "latent", {**FOUND, "seen": np.zeros((2, 3), bool)})["calibration"]
    assert unseen == {"confidence": None, "accuracy": None, "nll": None}
    # The camera cannot tell red ones apart: classes 1 and 2; three of five.
    assert make.case(CONFIG, "camera_alone", FOUND)["ambiguous_reported"] == pytest.approx(3 / 5)


def test_policies_are_compared_with_the_latent_one_arena_by_arena():
    found = {**FOUND, "time_s": np.array([12.0, 22.0])}
    block = make.missions(CONFIG, {"latent": FOUND, "naive": found})
    assert set(block) == {"latent", "naive"}
    assert "intervals" not in block["latent"]
    assert block["naive"]["intervals"]["time_s"] == {"mean": 2.0, "low": 2.0, "high": 2.0}
