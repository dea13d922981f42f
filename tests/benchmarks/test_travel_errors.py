"""Errors of the travel model against trips of missions, and their table."""

import dataclasses

import numpy as np
import pytest

from benchmarks import travel
from jaxsense.config import TravelConfig

ORIGIN = {
    **{"command": "python -m x", "commit": "0" * 40, "date": "2026-01-01", "cores": 2},
    **{"device": "cpu", "versions": {"jax": "0.10.2"}},
}
MODEL = TravelConfig(speed=0.5, turn_rate=2.0, view_distance=0.6, look_seconds=1.0)
# Straight ahead, from within the distance, and after a quarter of a turn.
POSES = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, np.pi / 2]])
PLACES = np.array([[2.6, 0.0], [0.5, 0.0], [1.6, 0.0]])
TAKEN = np.array([5.0, 1.0, 1.0 + np.pi / 4 + 2.0])


def test_a_model_that_fits_has_no_error_and_a_look_that_takes_longer_has_it():
    assert travel._errors(MODEL, POSES, PLACES, TAKEN)["median_error_s"] == pytest.approx(0.0)
    late = travel._errors(MODEL, POSES, PLACES, TAKEN + np.array([0.0, 1.0, 2.0]))
    assert late["median_error_s"] == pytest.approx(1.0)
    assert late["root_mean_square_error_s"] == pytest.approx(np.sqrt(5 / 3))


def test_the_fit_finds_the_model_that_trips_were_made_with():
    rng = np.random.default_rng(0)
    poses = np.column_stack([rng.uniform(-2, 2, (200, 2)), rng.uniform(-np.pi, np.pi, 200)])
    places = rng.uniform(-2, 2, (200, 2))
    taken = np.asarray(travel._predict(MODEL, poses, places))
    found = travel.fit(poses, places, taken)
    assert dataclasses.astuple(found) == pytest.approx(dataclasses.astuple(MODEL), abs=1e-3)


def test_the_table_holds_missions_settings_and_the_best_fit():
    errors = travel._errors(MODEL, POSES, PLACES, TAKEN)
    results = {**ORIGIN, "trips": 3, "mean_s": 3.26, "models": {"settings": errors}}
    lines = travel.table(results).splitlines()
    assert lines[2] == "| missions |  |  |  |  | 3.26 s |  |  |"
    assert lines[3] == "| settings | 0.50 | 2.00 | 0.60 | 1.00 | 3.26 s | 0.00 s | 0.00 s |"
