"""Means and intervals over several seeds."""

import pytest

from jaxsense.summary import statistics


def test_statistics_are_those_of_student():
    # The mean of 1 and 3 is 2, its standard error 1, and t(.975, 1 degree of freedom) 12.706.
    found = statistics.statistics(
        [{"a": {"b": 1}, "c": [5.0, None], "d": "x"}, {"a": {"b": 3}, "c": [5.0, 1.0], "d": "y"}]
    )
    assert found["a"]["b"] == pytest.approx({"mean": 2.0, "low": -10.706, "high": 14.706}, abs=1e-3)
    assert found["c"] == [{"mean": 5.0, "low": 5.0, "high": 5.0}, None]
    assert "d" not in found
    some = statistics.statistics([{"a": None, "b": 1.0}, {"a": 2.0, "b": None}, {"a": 2.0}])
    assert some == {"a": None}
    assert statistics.statistics([{"a": 3.0}]) == {"a": {"mean": 3.0, "low": None, "high": None}}


def test_the_times_of_seeds_add_up():
    stages = {"jmvae": {"compile_s": 4.0, "run_s": 6.0}}
    half = {"total_s": 5.0, "stages": {"jmvae": {"compile_s": 2.0, "run_s": 3.0}}}
    blocks = {key: {"x": 1.0} for key in ("detectors", "jmvae", "belief", "dqn", "mission")}
    runs = [{"seed": seed, "timing": half, **blocks} for seed in (4, 5)]
    total, of_each, means = statistics.of_seeds(runs)
    assert total == {"total_s": 10.0, "stages": stages}
    assert of_each == {"4": blocks, "5": blocks}
    assert means["mission"] == {"x": {"mean": 1.0, "low": 1.0, "high": 1.0}}
