"""Calibration of probabilities, by hand."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxsense.vae import calibration


def test_calibration_by_hand():
    # In the bin above 14/15: .95 and 1.0, of which one is right; in that above .6: .65, right.
    probabilities = jnp.array([[0.95, 0.05], [0.0, 1.0], [0.65, 0.35]])
    labels = jnp.array([0, 0, 0])
    expected = (abs(0.95 + 1.0 - 1) + abs(0.65 - 1)) / 3
    assert calibration.calibration_error(probabilities, labels) == pytest.approx(expected, abs=1e-6)
    found = calibration.negative_log_likelihood(probabilities[::2], labels[::2])
    assert found == pytest.approx(-(np.log(0.95) + np.log(0.65)) / 2, rel=1e-5)
    # A label of probability zero costs no more than a finite number.
    assert np.isfinite(calibration.negative_log_likelihood(probabilities, labels))


def test_probabilities_that_are_true_are_calibrated():
    rng = np.random.default_rng(0)
    first = rng.uniform(size=40_000)
    labels = jnp.array((rng.uniform(size=40_000) > first).astype(np.int32))
    probabilities = jnp.array(np.stack([first, 1 - first], axis=1), jnp.float32)
    assert calibration.calibration_error(probabilities, labels) < 0.01
    bent = probabilities**3 / jnp.sum(probabilities**3, axis=1, keepdims=True)
    assert calibration.calibration_error(bent, labels) > 0.1
