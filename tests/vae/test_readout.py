"""Class probabilities in a belief, by hand."""

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxsense.core.types import Belief
from jaxsense.vae import fusion, readout
from jaxsense.vae.jmvae import Jmvae

MODEL = Jmvae(("camera", "lidar"), (2, 2), 2, (4,))
CLASSES = Belief(jnp.array([[1.2, 0.9], [-0.8, 0.9], [-0.8, -1.3]]), jnp.full((3, 2), 0.4))
MATRIX = readout.readout_matrix(CLASSES)
PRIOR = fusion.prior(MODEL, 20.0)


def read(belief, prior=PRIOR):
    return readout.class_probabilities(MATRIX, prior, belief)


@given(st.lists(st.floats(0.001, 1.0), min_size=3, max_size=3))
@settings(max_examples=30, deadline=None)
def test_a_mixture_gives_back_its_weights(shares):
    shares = np.array(shares) / np.sum(shares)
    found = read(readout.mixture(CLASSES, jnp.array(shares, jnp.float32)))
    np.testing.assert_allclose(found, shares, atol=2e-5)


def test_a_mixture_has_the_moments_by_hand():
    found = readout.mixture(CLASSES, jnp.array([0.5, 0.5, 0.0]))
    np.testing.assert_allclose(found.mean, [0.2, 0.9], atol=1e-6)
    np.testing.assert_allclose(found.std, [np.sqrt(0.16 + 1.0), 0.4], atol=1e-6)


def test_a_single_dimension_holds_three_classes():
    line = Belief(jnp.array([[-1.0, 0.0], [0.0, 0.0], [1.0, 0.0]]), jnp.full((3, 2), 0.3))
    shares = jnp.array([0.2, 0.3, 0.5])
    matrix, mixed = readout.readout_matrix(line), readout.mixture(line, shares)
    found = readout.class_probabilities(matrix, PRIOR, mixed)
    np.testing.assert_allclose(found, shares, atol=1e-4)


@pytest.mark.parametrize("variance", [20.0, 1.0, 0.01])
def test_a_prior_may_be_of_any_class_however_wide_it_is(variance):
    # Of the classes in the first dimension, 1.2^2 + .4^2 = 1.6 is the largest mean square.
    prior = fusion.prior(MODEL, variance)
    np.testing.assert_allclose(read(prior, prior), 1 / 3, atol=1e-6)
    rounded = Belief(prior.mean, jnp.nextafter(prior.std, 0.0))
    np.testing.assert_allclose(read(rounded, prior), 1 / 3, atol=1e-6)


def test_a_belief_that_is_only_near_the_prior_is_read_by_its_moments():
    # A prior with the moments of a mixture of 1 to 4 to 4, which it would read as if it were one.
    shares = np.array([1, 4, 4]) / 9
    prior = readout.mixture(CLASSES, jnp.array(shares, jnp.float32))
    np.testing.assert_allclose(read(prior, prior), 1 / 3, atol=1e-6)
    step = 1e-3 * prior.std
    for near in (Belief(prior.mean + step, prior.std), Belief(prior.mean, prior.std + step)):
        np.testing.assert_allclose(read(near, prior), shares, atol=0.01)
