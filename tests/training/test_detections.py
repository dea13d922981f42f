"""What detectors are trained and calibrated on."""

import dataclasses
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tiny import KEY, TINY, stage_of

from jaxsense.core import supervised
from jaxsense.core.types import pytree
from jaxsense.training.gating import Examples
from jaxsense.training.surveys import Survey, Surveys
from jaxsense.vae import detectors, gate


def given_to_detectors(windows, labels):
    """Inputs of a detector's stage, of one PoI a scene; looks at nothing are those at PoIs."""
    looks, nothing = gate.Looks(windows, jnp.ones(len(windows))), cast("Any", ())
    examples = Examples(labels, looks.distances, looks, looks)
    survey = Survey(
        labels[:, None], nothing, (windows[:, None],) * 2, jnp.ones((len(labels), 2, 1))
    )
    return {"surveys": Surveys(survey, nothing), "examples": (examples, examples)}


@pytest.mark.slow
@pytest.mark.parametrize(("share", "trained_on"), [(0.0, 10), (0.1, 9), (0.25, 7), (0.5, 5)])
def test_looks_that_calibrate_a_detector_are_not_trained_on(share, trained_on, monkeypatch):
    config = dataclasses.replace(TINY.detector, calibration=share)
    config = dataclasses.replace(TINY, detector=config)
    # Of .25 of ten looks, three calibrate.
    windows, labels = jnp.arange(20.0).reshape(10, 2), jnp.arange(10) % 2
    given, used = given_to_detectors(windows, labels), {}

    def fit(key, state, problem, number):
        used["train"], used["labels"] = problem.detector.windows, problem.detector.labels
        used["shown"] = problem.gate.shown.windows
        return state, jnp.zeros(number)

    def calibrate(detector, windows, labels):
        used["calibrate"] = windows
        np.testing.assert_array_equal(labels, (windows[:, 0] / 2) % 2)
        return "calibrated"

    monkeypatch.setattr(supervised, "fit", fit)
    monkeypatch.setattr(detectors, "calibrate", calibrate)
    stage = stage_of("detector_lidar", config)
    state = stage.begin(KEY, config, **given)
    state, _ = stage.advance(KEY, config, state, **given)
    found = stage.finish(config, state, **given)
    np.testing.assert_allclose(state[0].offset, windows[:trained_on].mean(axis=0))
    np.testing.assert_array_equal(used["train"], windows[:trained_on])
    np.testing.assert_array_equal(used["shown"], windows[:trained_on])
    np.testing.assert_array_equal(used["labels"], labels[:trained_on])
    if share:
        np.testing.assert_array_equal(used["calibrate"], windows[trained_on:])
        assert found == "calibrated"
    else:
        assert "calibrate" not in used


@pytree
class First(detectors.Fitting):
    """Draws the rows that it has when it is fitted together with a gate."""

    def draw(self, key, number):
        return super().draw(jax.random.split(key)[0], number)


@pytest.mark.slow
def test_without_calibration_a_detector_is_what_was_trained():
    windows, labels = jax.random.normal(KEY, (48, 6)), jnp.arange(48) % 2
    given, config = given_to_detectors(windows, labels), TINY.detector
    assert config.calibration == 0
    stage = stage_of("detector_camera")
    state = stage.begin(KEY, TINY, **given)
    detector = detectors.init(KEY, windows, 2, config)
    problem = First(config, detector, windows, labels)
    fit = supervised.start(detector.params, config)
    for key in stage.chunk_keys(KEY)[:2]:
        state, _ = stage.advance(key, TINY, state, **given)
        fit, _ = supervised.fit(key, fit, problem, 3)
    found = stage.finish(TINY, state, **given)
    # Its gate, which learns in the same steps, leaves it as it is.
    expected = dataclasses.replace(detector, params=fit.params, gate=found.gate)
    jax.tree.map(np.testing.assert_array_equal, found, expected)
    before, after = (jax.tree.leaves(x.gate.params)[1] for x in (detector, found))
    assert np.abs(after - before).max() > 0
    assert np.isfinite(found.gate.threshold)
