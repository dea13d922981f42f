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
    assert place.best(NOISY, 0.5, stays=True) == pytest.approx((0.0, 0.5), abs=1e-4)
    # A second look would save at most half of an error, 4 s.
    far = dataclasses.replace(NOISY, drive=4.0)
    assert place.best(far, 8.0, stays=False) == pytest.approx((1.0, 0.1), abs=2e-3)


def test_where_a_look_is_as_new_as_elsewhere_nobody_drives():
    for price in (50.0, 500.0):
        time, wrong = place.best(NOISY, price, stays=True)
        must_drive, as_wrong = place.best(NOISY, price, stays=False)
        assert time < must_drive
        # If repeated looks tell nothing, a robot that may stay does as one that must drive.
        alike, as_right = place.best(
            Sensor(accuracy=0.9, strength=1e9, look=1.0, drive=2.0), price, stays=True
        )
        assert (alike, as_right) == pytest.approx((must_drive, as_wrong), abs=1e-4)
        assert wrong < as_wrong


def test_where_staying_tells_nothing_it_saves_nothing():
    repeats = Sensor(accuracy=0.9, strength=1e9, look=1.0, drive=2.0)
    stays, drives = (place.seconds_at(repeats, stays=stays) for stays in (True, False))
    np.testing.assert_allclose(stays, drives, rtol=1e-3)
    fresh, drives = (place.seconds_at(NOISY, stays=stays) for stays in (True, False))
    assert np.all(np.array(fresh) < 0.75 * np.array(drives))
