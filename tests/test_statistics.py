"""Means and intervals over several seeds."""

import pytest

from jaxsense.run import seeds


def test_statistics_are_those_of_student():
    # The mean of 1 and 3 is 2, its standard error 1, and t(.975, 1 degree of freedom) 12.706.
    found = seeds.statistics(
        [{"a": {"b": 1}, "c": [5.0, None], "d": "x"}, {"a": {"b": 3}, "c": [5.0, 1.0], "d": "y"}]
    )
    assert found["a"]["b"] == pytest.approx({"mean": 2.0, "low": -10.706, "high": 14.706}, abs=1e-3)
    assert found["c"] == [{"mean": 5.0, "low": 5.0, "high": 5.0}, None]
    assert "d" not in found
    assert seeds.statistics([{"a": 3.0}]) == {"a": {"mean": 3.0, "low": None, "high": None}}
