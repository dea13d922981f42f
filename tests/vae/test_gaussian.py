"""Products of Gaussians by hand; losses and figures test what else they do."""

import jax.numpy as jnp
import numpy as np

from jaxsense.core.types import Belief
from jaxsense.vae import gaussian


def test_a_product_with_what_knows_nothing_stays_as_it_is():
    means, log_vars = jnp.array([[1.0]]), jnp.log(jnp.array([[0.5]]))
    # One alone stays as it is, and one wider than the prior takes nothing away from another.
    np.testing.assert_allclose(gaussian.product(means, log_vars), ([1.0], [-np.log(2)]))
    mean, log_var = gaussian.product(jnp.array([[1.0], [0.0]]), jnp.log(jnp.array([[0.5], [9.0]])))
    np.testing.assert_allclose(mean, [1.0], rtol=1e-6)
    np.testing.assert_allclose(log_var, [-np.log(2)], rtol=1e-6)


def test_product_of_experts_by_hand():
    of = lambda mean, std: Belief(jnp.array([mean]), jnp.array([std]))  # noqa: E731
    prior = of(0.0, 1.0)
    # Precisions 4 + 4 - 1 = 7, and (4 * 1 + 4 * 3 - 0) / 7.
    found = gaussian.product_of_experts(of(1.0, 0.5), of(3.0, 0.5), prior)
    np.testing.assert_allclose(found.mean, [16 / 7], rtol=1e-6)
    np.testing.assert_allclose(found.std, [7**-0.5], rtol=1e-6)
    # A look that knows nothing changes nothing.
    found = gaussian.product_of_experts(of(1.0, 0.5), prior, prior)
    np.testing.assert_allclose([found.mean[0], found.std[0]], [1.0, 0.5], rtol=1e-6)
