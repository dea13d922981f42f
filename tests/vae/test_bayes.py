"""Exact Bayes over the classes, and the product of experts, by hand."""

import jax.numpy as jnp
import numpy as np

from jaxsense.core.types import Belief
from jaxsense.vae import bayes
from jaxsense.vae.bayes import Bayes

# Red or green, cylinder or cube: classes are green cylinder, red cylinder, red cube.
LABELS = np.array([[1, 0, 0], [0, 0, 1]])


def test_likelihoods_of_classes_by_hand():
    # Of three classes one is green and two are red: .2 / (1/3) = .6 and .8 / (2/3) = 1.2.
    found = bayes.log_likelihoods(jnp.array([0.8, 0.2]), LABELS[0])
    np.testing.assert_allclose(np.exp(found), [0.6, 1.2, 1.2], rtol=1e-6)
    # One cube and two cylinders; what the detector rules out keeps a chance of 1e-12.
    found = bayes.log_likelihoods(jnp.array([1.0, 0.0]), LABELS[1])
    np.testing.assert_allclose(np.exp(found), [1.5, 1.5, 3e-12], rtol=1e-5)


def test_product_of_experts_by_hand():
    of = lambda mean, std: Belief(jnp.array([mean]), jnp.array([std]))  # noqa: E731
    prior = of(0.0, 1.0)
    # Precisions 4 + 4 - 1 = 7, and (4 * 1 + 4 * 3 - 0) / 7.
    found = bayes.product_of_experts(of(1.0, 0.5), of(3.0, 0.5), prior)
    np.testing.assert_allclose(found.mean, [16 / 7], rtol=1e-6)
    np.testing.assert_allclose(found.std, [7**-0.5], rtol=1e-6)
    # A look that knows nothing changes nothing.
    found = bayes.product_of_experts(of(1.0, 0.5), prior, prior)
    np.testing.assert_allclose([found.mean[0], found.std[0]], [1.0, 0.5], rtol=1e-6)


def test_the_filter_of_all_modalities_takes_the_labels_of_each():
    exact, look = Bayes(jnp.array(LABELS)), jnp.array([0.8, 0.2])
    np.testing.assert_allclose(np.exp(exact.prior), [1 / 3] * 3, rtol=1e-6)
    for modality in range(2):
        likelihood = bayes.log_likelihoods(look, LABELS[modality])
        np.testing.assert_array_equal(exact.log_likelihoods(look, modality), likelihood)
    after = exact.update(exact.prior, look, 0)
    np.testing.assert_allclose(np.exp(after), [0.2, 0.4, 0.4], atol=1e-6)
    # Times .8 / (2/3), .8 / (2/3) and .2 / (1/3): .24, .48 and .24.
    after = exact.update(after, look, 1)
    np.testing.assert_allclose(np.exp(after), [0.25, 0.5, 0.25], atol=1e-6)
