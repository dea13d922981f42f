"""Differences between policies, and looks and time at equal accuracy, as worked by hand."""

import math

import numpy as np
import pytest
from summaries import OTHERS, THIS

from jaxsense.summary import compare


def test_differences_are_taken_arena_by_arena():
    # Of two PoIs: half, both and both right, against none, half and half.
    found = {
        "is_right": np.array([[True, False], [True, True], [True, True]]),
        "observations_per_poi": np.array([2.0, 1.0, 3.0]),
        "time_s": np.array([10.0, 20.0, 30.0]),
    }
    other = {
        "is_right": np.array([[False, False], [True, False], [False, True]]),
        "observations_per_poi": np.array([3.0, 1.0, 5.0]),
        "time_s": np.array([11.0, 22.0, 33.0]),
    }
    differences = compare.differences(found, other)
    assert differences["accuracy"] == {"mean": 0.5, "low": 0.5, "high": 0.5}
    # -1, 0 and -2: the mean -1, its error 1 / sqrt(3), and t(.975, 2) 4.303. Unpaired, the large
    # differences between arenas would count.
    half = 4.303 / np.sqrt(3)
    expected = {"mean": -1.0, "low": -1 - half, "high": -1 + half}
    assert differences["observations_per_poi"] == pytest.approx(expected, abs=1e-3)
    assert differences["time_s"]["mean"] == -2


def block(accuracy, looks, seconds):
    # Long missions lift the mean above the median.
    times = {"time_s": seconds, "mean_time_s": seconds + 10}
    return {"accuracy": accuracy, "observations_per_poi": looks, **times, "episodes": 8}


NAIVE = {
    "naive": block(0.90, 2.0, 40.0),
    "naive_2": block(0.96, 4.0, 50.0),
    "naive_3": block(0.98, 6.0, 60.0),
}
FASTER = "By median times, the latent policy is 10 % faster than naive exploration"
AS_FAST = "By median times, the latent policy is"


@pytest.mark.parametrize(
    ("accuracy", "others", "told"),
    [
        # 36 / 40 = .9 and 36 / 30 = 1.2; `random` is faster, but wrong, and nobody alone counts.
        (0.9, {}, f"{FASTER}."),
        (
            0.9,
            {"auction": block(0.9, 2.0, 30.0), "nearest": block(0.98, 2.0, 33.0)},
            f"{FASTER} (and 20 % slower than auction).",
        ),
        (0.9, {"naive_3": block(0.99, 6.0, 20.0)}, f"{FASTER}."),
        # Half a percent does not matter: 36 / 36.18 = .99502, and 36 / 36.19 = .99475.
        (0.9, {"naive": block(0.9, 2.0, 36.18)}, f"{AS_FAST} as fast as naive exploration."),
        (0.9, {"naive": block(0.9, 2.0, 36.19)}, f"{AS_FAST} 1 % faster than naive exploration."),
    ],
)
def test_the_verdict_names_naive_exploration_and_the_fastest_policy(accuracy, others, told):
    wrong = {"random": block(0.5, 1.0, 9.0), "camera_alone": block(0.99, 1.0, 8.0)}
    latent = block(accuracy, 1.5, 36.0)
    assert compare.verdict({**NAIVE, "latent": latent, **wrong, **others}) == told


@pytest.mark.parametrize(
    ("nll", "expected"),
    [
        # At most 1.2 x .5 + .01 = .61 and 1.2 x .1 + .01 = .13.
        ([0.61, 0.13], None),
        ([0.5, 0.14], "NLL after 2 looks is 0.14, that of exact Bayes 0.10."),
        ([0.9, 0.14], "NLL after 1 look is 0.90, that of exact Bayes 0.50."),
        ([0.5, math.nan], "NLL after 2 looks is nan"),
        # .7 - .5 = .2 after one look, and .5 - .1 = .4 after two, where the NLL itself is lower.
        ([0.7, 0.5], "NLL after 2 looks is 0.50, that of exact Bayes 0.10."),
    ],
)
def test_a_map_that_loses_information_is_told(nll, expected):
    block = {"looks": [1, 2], "nll": nll, "bayes_nll": [0.5, 0.1]}
    told = compare.unsound(block)
    assert told is None if expected is None else expected in told


def test_statistics_are_those_of_student():
    # The mean of 1 and 3 is 2, its standard error 1, and t(.975, 1 degree of freedom) 12.706.
    found = compare.statistics(
        [{"a": {"b": 1}, "c": [5.0, None], "d": "x"}, {"a": {"b": 3}, "c": [5.0, 1.0], "d": "y"}]
    )
    assert found["a"]["b"] == pytest.approx({"mean": 2.0, "low": -10.706, "high": 14.706}, abs=1e-3)
    assert found["c"] == [{"mean": 5.0, "low": 5.0, "high": 5.0}, None]
    assert "d" not in found
    some = compare.statistics([{"a": None, "b": 1.0}, {"a": 2.0, "b": None}, {"a": 2.0}])
    assert some == {"a": None}
    assert compare.statistics([{"a": 3.0}]) == {"a": {"mean": 3.0, "low": None, "high": None}}
    # Of several numbers, each by itself.
    bounds = compare.bounds(np.array([[1.0, 2.0], [3.0, 2.0]]))
    np.testing.assert_allclose(bounds, [[-10.706, 2], [14.706, 2]], atol=1e-3)


def test_the_times_of_seeds_add_up():
    half = {"total_s": 5.0, "stages": {"jmvae": {"compile_s": 2.0, "run_s": 3.0}}}
    blocks = {key: {"x": 1.0} for key in ("detectors", "jmvae", "belief", "dqn", "mission")}
    runs = [{"seed": seed, "timing": half, **blocks} for seed in (4, 5)]
    total, of_each, means = compare.of_seeds(runs)
    assert total == {"total_s": 10.0, "stages": {"jmvae": {"compile_s": 4.0, "run_s": 6.0}}}
    assert of_each == {"4": blocks, "5": blocks}
    assert means["mission"] == {"x": {"mean": 1.0, "low": 1.0, "high": 1.0}}


@pytest.mark.parametrize("name", OTHERS)
def test_origins_differ_in_code_versions_and_machine_and_not_in_days(name):
    dated, other = {**THIS, "date": "2026-11-28"}, OTHERS[name]
    assert compare.differences_of([THIS, dated]) == {}
    assert compare.several_origins([dated, THIS, THIS]) is None
    (found,) = compare.differences_of([other, THIS, THIS, other]).items()
    theirs, ours = (str({**x, **x["versions"]}[name]) for x in (other, THIS))
    assert found == (name, [theirs, ours, ours, theirs])
    told = f"Stages of this run were made with different {name} {theirs} and {ours}."
    assert compare.several_origins([other, dated, other]) == told
