"""Divergence, sampling and moment matching against hand-worked numbers."""

import jax.numpy as jnp
import numpy as np

from jaxsense.core.types import Belief
from jaxsense.vae import gaussian

LOG4 = np.log(4.0)


def test_kl_of_each_dimension_adds_up_as_worked_by_hand():
    # Dimension 1, N(1, 4) to N(0, 1): (4/1 + 1/1 - 1 - ln 4) / 2 = 1.306853.
    # Dimension 2, N(0, 1) to N(2, 4): (1/4 + 4/4 - 1 + ln 4) / 2 = 0.818147.
    p, q = (
        (jnp.array([1.0, 0.0]), jnp.array([LOG4, 0.0])),
        (
            jnp.array([0.0, 2.0]),
            jnp.array([0.0, LOG4]),
        ),
    )
    np.testing.assert_allclose(gaussian.kl_divergence(*p, *q), 1.306853 + 0.818147, rtol=1e-5)
    # Turned round: (1/4 + 1/4 - 1 + ln 4) / 2 = 0.443147, (4 + 4 - 1 - ln 4) / 2 = 2.806853.
    np.testing.assert_allclose(gaussian.kl_divergence(*q, *p), 0.443147 + 2.806853, rtol=1e-5)


def test_moment_match_as_worked_by_hand():
    # Dimension 1: mean (0 + 4) / 2 = 2, variance (1 + 9) / 2 + (4 + 4) / 2 = 9.
    # Dimension 2: two equal components are matched by themselves.
    parts = Belief(jnp.array([[0.0, 1.0], [4.0, 1.0]]), jnp.array([[1.0, 0.5], [3.0, 0.5]]))
    found = gaussian.moment_match(parts)
    np.testing.assert_allclose(found.mean, [2.0, 1.0], rtol=1e-6)
    np.testing.assert_allclose(found.std, [3.0, 0.5], rtol=1e-6)


def test_a_product_with_what_knows_nothing_stays_as_it_is():
    means, log_vars = jnp.array([[1.0]]), jnp.log(jnp.array([[0.5]]))
    # One alone stays as it is, and one wider than the prior takes nothing away from another.
    np.testing.assert_allclose(gaussian.product(means, log_vars), ([1.0], [-np.log(2)]))
    mean, log_var = gaussian.product(jnp.array([[1.0], [0.0]]), jnp.log(jnp.array([[0.5], [9.0]])))
    np.testing.assert_allclose(mean, [1.0], rtol=1e-6)
    np.testing.assert_allclose(log_var, [-np.log(2)], rtol=1e-6)


def test_sample_as_worked_by_hand():
    # Standard deviations 2 and 1/2: 2 + 2 x 1.5 = 5, -1 - .5 x 2 = -2; in a batch, -1 + .5 x 4.
    mean, log_var = jnp.array([2.0, -1.0]), jnp.array([LOG4, -LOG4])
    z = gaussian.sample(jnp.array([1.5, -2.0]), mean, log_var)
    np.testing.assert_allclose(z, [5.0, -2.0], rtol=1e-6)
    two = jnp.stack([mean, mean], axis=-1), jnp.stack([log_var, log_var], axis=-1)
    z = gaussian.sample(jnp.array([[1.5, 0.0], [-2.0, 4.0]]), *two)
    np.testing.assert_allclose(z, [[5.0, 2.0], [-2.0, 1.0]], rtol=1e-6)


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
