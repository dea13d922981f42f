"""Exact Bayes over the classes, by hand."""

import jax.numpy as jnp
import numpy as np

from jaxsense.vae.readout import Bayes

# Red or green, cylinder or cube: classes are green cylinder, red cylinder, red cube.
EXACT = Bayes(jnp.array([[1, 0, 0], [0, 0, 1]]))


def test_likelihoods_of_classes_by_hand():
    # Of three classes one is green and two are red: .2 / (1/3) = .6 and .8 / (2/3) = 1.2.
    found = EXACT.log_likelihoods(jnp.array([0.8, 0.2]), 0)
    np.testing.assert_allclose(np.exp(found), [0.6, 1.2, 1.2], rtol=1e-6)
    # One cube and two cylinders; what the detector rules out keeps a chance of 1e-12.
    found = EXACT.log_likelihoods(jnp.array([1.0, 0.0]), 1)
    np.testing.assert_allclose(np.exp(found), [1.5, 1.5, 3e-12], rtol=1e-5)


def test_looks_multiply_the_odds_of_classes():
    look = jnp.array([0.8, 0.2])
    np.testing.assert_allclose(np.exp(EXACT.prior), [1 / 3] * 3, rtol=1e-6)
    after = EXACT.update(EXACT.prior, look, 0)
    np.testing.assert_allclose(np.exp(after), [0.2, 0.4, 0.4], atol=1e-6)
    # Times .8 / (2/3), .8 / (2/3) and .2 / (1/3): .24, .48 and .24.
    after = EXACT.update(after, look, 1)
    np.testing.assert_allclose(np.exp(after), [0.25, 0.5, 0.25], atol=1e-6)
