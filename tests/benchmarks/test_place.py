"""One PoI by dynamic programming: evidence that is exact, and robots worked by hand."""

import dataclasses

import numpy as np
import pytest

from benchmarks import place
from benchmarks.place import Sensor

LOG_ODDS = place._LOG_ODDS
CHANCE = 1 / (1 + np.exp(-LOG_ODDS))
NOISY = Sensor(accuracy=0.9, strength=0.0, look=1.0, drive=2.0)


def test_evidence_is_exact():
    after = Sensor(accuracy=0.9, strength=1.0, look=1.0, drive=2.0).after_each
    np.testing.assert_allclose(after.sum(axis=2), 1.0, atol=1e-12)
    # The probability of a label does not change on average.
    inside = np.abs(LOG_ODDS) < 6
    np.testing.assert_allclose(
        (after @ CHANCE)[:, inside], np.tile(CHANCE[inside], (8, 1)), atol=2e-3
    )
    right = (after @ np.maximum(CHANCE, 1 - CHANCE))[:, len(LOG_ODDS) // 2]
    assert right[0] == pytest.approx(0.9, abs=2e-3)
    # With a strength of 1, a third of the deviation, a ninth of the evidence, after two looks.
    assert right[2] == pytest.approx(0.665, abs=2e-3)


def test_who_pays_little_looks_once_or_never():
    assert place.best(NOISY, 0.5) == pytest.approx((0.0, 0.5), abs=1e-4)
    # A second look would save at most half of an error, 4 s.
    far = dataclasses.replace(NOISY, strength=1e9, drive=4.0)
    assert place.best(far, 8.0, 1.0) == pytest.approx((1.0, 0.1), abs=2e-3)


def test_where_a_look_is_as_new_as_elsewhere_nobody_drives():
    far = dataclasses.replace(NOISY, drive=50.0)
    for price in (50.0, 500.0):
        assert place.best(far, price) == pytest.approx(place.best(NOISY, price), abs=1e-4)
        assert place.best(NOISY, price, 1.0) == pytest.approx(place.best(NOISY, price), abs=1e-4)


def test_where_staying_tells_nothing_everybody_drives():
    repeats = Sensor(accuracy=0.9, strength=1e9, look=1.0, drive=2.0)
    for price in (50.0, 500.0):
        free = place.best(repeats, price)
        assert place.best(repeats, price, 1.0) == pytest.approx(free, abs=1e-4)
        # One that stays wherever anything is new never drives, and errs as after one look.
        stays = place.best(repeats, price, 0.0)
        assert stays == pytest.approx((1.0, 0.1), abs=2e-3)


def test_a_rule_stays_while_its_share_is_new_and_then_drives():
    # Weights of looks from one place: 1, 1/4, 1/9.
    sensor = Sensor(accuracy=0.9, strength=1.0, look=1.0, drive=0.5)
    assert sensor.weights[:3] == pytest.approx([1, 1 / 4, 1 / 9])
    for price in (50.0, 500.0):
        free = place.best(sensor, price)
        costs = {share: time + price * wrong for share, (time, wrong) in _rules(sensor, price)}
        assert costs[0.3] == pytest.approx(costs[1.0])
        assert costs[0.2] == costs[0.25]
        assert min(costs.values()) >= free[0] + price * free[1] - 1e-4
        # Driving for half a second pays when a second look from here is a quarter of one.
        assert costs[1.0] < costs[0.0]


def _rules(sensor, price):
    return [(share, place.best(sensor, price, share)) for share in (1.0, 0.3, 0.25, 0.2, 0.0)]


def test_the_table_shows_what_rules_need_beyond_the_best_choice():
    origin = {
        "command": "python -m benchmarks.place RUN", "device": "cpu", "cores": 2,
        "commit": "0123456789abcdef", "date": "2026-11-26", "versions": {"jax": "0.10.2"},
    }  # fmt: skip
    rules = dict(zip(place.RULES, ([3, 2.2, 4], [3, 2.0, 4], [3, 3.0, 4]), strict=True))
    row = {"sensor": "camera", "drive": 0.5, "best": [1.0, 2.0, 4.0], **rules}
    found = place.table({**origin, "errors": place.ERRORS, "rows": [row]}, 0.01)
    assert "| camera, 0.5 s | 2.00 s | +10.0% | +0.0% | +50.0% |" in found
