"""What detectors are trained and calibrated on."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from tiny import KEY, TINY, given_problem, stage_of

from jaxsense.core import supervised
from jaxsense.training.detections import Survey, Surveys
from jaxsense.vae import detectors
from jaxsense.vae.detectors import Looks

NOTHING = Looks(100 + jnp.arange(16.0).reshape(8, 2), jnp.ones(8))


def given_to_detectors(windows, labels):
    """Inputs of a detector's stage, of one PoI a scene."""
    classes = 2 * labels[:, None]  # a green cylinder, or a red cube
    of_both, distances = (windows[:, None],) * 2, jnp.ones((len(labels), 2, 1))
    survey = Survey(classes, of_both, distances)
    others = Survey(classes, tuple(200 + x for x in of_both), distances)
    return {"surveys": Surveys(survey, others, others, others), "examples": (NOTHING, NOTHING)}


@pytest.mark.parametrize(("share", "trained_on"), [(0.0, 10), (0.25, 7)])
def test_looks_that_calibrate_a_detector_are_not_trained_on(share, trained_on, monkeypatch):
    config = dataclasses.replace(TINY.detector, calibration=share, num_scans=10)
    arena = dataclasses.replace(TINY.arena, num_pois=1)
    config = dataclasses.replace(TINY, detector=config, arena=arena)
    # Of .25 of ten looks, three calibrate.
    windows, labels = jnp.arange(20.0).reshape(10, 2), jnp.arange(10) % 2
    given, used = given_to_detectors(windows, labels), {}

    def fit(key, state, problem, number):
        used["problem"] = problem
        return state, jnp.zeros(number)

    def calibrate(detector, shown, labels):
        used["calibrate"] = shown.windows
        np.testing.assert_array_equal(labels, (shown.windows[:, 0] / 2) % 2)
        return detector

    def fitted(detector, shown, nothing):
        used["checks"], used["nothing"] = shown.windows, nothing.windows
        return "fitted"

    monkeypatch.setattr(supervised, "fit", fit)
    monkeypatch.setattr(detectors, "problem", given_problem)
    monkeypatch.setattr(detectors, "calibrate", calibrate)
    monkeypatch.setattr(detectors, "fitted", fitted)
    stage = stage_of("detector_lidar", config)
    state = stage.begin(KEY, config, **given)
    state, _ = stage.advance(KEY, config, state, **given)
    assert stage.finish(config, state, **given) == "fitted"
    np.testing.assert_allclose(state[0].offset, windows[:trained_on].mean(axis=0))
    problem = used["problem"]
    np.testing.assert_array_equal(problem.shown.windows, windows[:trained_on])
    np.testing.assert_array_equal(problem.labels, labels[:trained_on])
    # A quarter of the looks at nothing sets the threshold, with looks of the bank.
    np.testing.assert_array_equal(problem.nothing.windows, NOTHING.windows[2:])
    np.testing.assert_array_equal(used["nothing"], NOTHING.windows[:2])
    np.testing.assert_array_equal(used["checks"], 200 + windows)
    assert ("calibrate" in used) == (share > 0)
    if share:
        np.testing.assert_array_equal(used["calibrate"], windows[trained_on:])
