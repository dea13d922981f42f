"""Divergence, sampling and moment matching against hand-worked numbers and Monte Carlo."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

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


def test_kl_of_a_distribution_to_itself_is_zero():
    mean, log_var = jnp.array([3.0, -1.0]), jnp.array([-2.0, 1.5])
    np.testing.assert_allclose(gaussian.kl_divergence(mean, log_var, mean, log_var), 0, atol=1e-6)


def test_kl_to_standard_normal_as_worked_by_hand():
    # (4 + 1 - 1 - ln 4) / 2 = 1.306853 for N(1, 4), and 0 for N(0, 1).
    kl = gaussian.kl_to_standard_normal(jnp.array([1.0, 0.0]), jnp.array([LOG4, 0.0]))
    np.testing.assert_allclose(kl, 1.306853, rtol=1e-5)


def test_kl_is_the_mean_log_ratio_of_the_densities():
    mean_p, std_p = np.array([0.5, -1.0, 2.0]), np.array([0.7, 1.5, 0.2])
    mean_q, std_q = np.array([0.0, 0.5, 1.9]), np.array([1.1, 1.0, 0.3])
    z = mean_p + std_p * np.random.default_rng(0).standard_normal((200_000, 3))

    def log_density(mean, std):  # without the constant, which cancels
        return np.sum(-0.5 * ((z - mean) / std) ** 2 - np.log(std), axis=-1)

    ratios = log_density(mean_p, std_p) - log_density(mean_q, std_q)
    standard_error = ratios.std() / np.sqrt(len(ratios))
    inputs = (mean_p, 2 * np.log(std_p), mean_q, 2 * np.log(std_q))
    kl = gaussian.kl_divergence(*(jnp.array(x, jnp.float32) for x in inputs))
    np.testing.assert_allclose(kl, ratios.mean(), atol=4 * standard_error)


def test_kl_of_unequal_shapes_raises():
    with pytest.raises(AssertionError):
        gaussian.kl_divergence(jnp.zeros(2), jnp.zeros(2), jnp.zeros(3), jnp.zeros(3))


def test_moment_match_as_worked_by_hand():
    # Dimension 1: mean (0 + 4) / 2 = 2, variance (1 + 9) / 2 + (4 + 4) / 2 = 9.
    # Dimension 2: two equal components are matched by themselves.
    mean, std = gaussian.moment_match(
        jnp.array([[0.0, 1.0], [4.0, 1.0]]), jnp.array([[1.0, 0.5], [3.0, 0.5]])
    )
    np.testing.assert_allclose(mean, [2.0, 1.0], rtol=1e-6)
    np.testing.assert_allclose(std, [3.0, 0.5], rtol=1e-6)


def test_moment_match_minimises_the_mean_divergence_from_the_components():
    means, stds = jax.random.normal(jax.random.key(0), (2, 5, 3))
    stds = jnp.exp(stds)

    @jax.jit
    def mean_kl(parameters):
        kl = jax.vmap(gaussian.kl_divergence, in_axes=(0, 0, None, None))
        return kl(means, 2 * jnp.log(stds), parameters[:3], parameters[3:]).mean()

    mean, std = gaussian.moment_match(means, stds)
    best = jnp.concatenate([mean, 2 * jnp.log(std)])
    for change in np.concatenate([0.1 * np.eye(6), -0.1 * np.eye(6)]):
        assert mean_kl(best + change) > mean_kl(best) + 1e-5


def test_sample_has_the_mean_and_standard_deviation():
    mean, log_var = jnp.array([2.0, -1.0]), jnp.array([LOG4, -LOG4])  # stds 2 and 1/2
    keys = jax.random.split(jax.random.key(0), 20_000)
    z = np.asarray(jax.vmap(gaussian.sample, in_axes=(0, None, None))(keys, mean, log_var))
    # Four standard errors of a mean, std / sqrt(20000); those of a std are smaller.
    np.testing.assert_array_less(np.abs(z.mean(axis=0) - mean), 4 * np.array([2, 0.5]) / 141.4)
    np.testing.assert_array_less(np.abs(z.std(axis=0) - [2, 0.5]), 4 * np.array([2, 0.5]) / 141.4)
    assert abs(np.corrcoef(z.T)[0, 1]) < 0.03


def test_sample_is_differentiable_in_mean_and_log_variance():
    key, mean, log_var = jax.random.key(1), jnp.array([2.0, -1.0]), jnp.array([LOG4, 0.0])
    z = gaussian.sample(key, mean, log_var)
    by_mean, by_log_var = jax.jacobian(gaussian.sample, argnums=(1, 2))(key, mean, log_var)
    np.testing.assert_allclose(by_mean, np.eye(2), atol=1e-6)
    # z = m + exp(v / 2) e, so dz/dv = exp(v / 2) e / 2 = (z - m) / 2.
    np.testing.assert_allclose(by_log_var, np.diag((z - mean) / 2), rtol=1e-5)
