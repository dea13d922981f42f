"""Diagonal Gaussians: divergence, sampling and moment matching."""

import chex
import jax
import jax.numpy as jnp

from jaxsense.core import checks


def kl_divergence(
    mean_p: jax.Array, log_var_p: jax.Array, mean_q: jax.Array, log_var_q: jax.Array
) -> jax.Array:
    """`KL(p || q)` of two diagonal Gaussians.

    Args:
      mean_p: `[D]`.
      log_var_p: `[D]` logarithm of the variances.
      mean_q: `[D]`.
      log_var_q: `[D]`.

    Returns:
      `[]` in nats.
    """
    chex.assert_rank(mean_p, 1, custom_message="mean_p")
    chex.assert_shape(log_var_p, mean_p.shape, custom_message="log_var_p")
    chex.assert_shape(mean_q, mean_p.shape, custom_message="mean_q")
    chex.assert_shape(log_var_q, mean_p.shape, custom_message="log_var_q")
    ratio = jnp.exp(log_var_p - log_var_q)
    distance = (mean_p - mean_q) ** 2 * jnp.exp(-log_var_q)
    return 0.5 * jnp.sum(ratio + distance - 1.0 - log_var_p + log_var_q)


def kl_to_standard_normal(mean: jax.Array, log_var: jax.Array) -> jax.Array:
    """`KL(N(mean, exp(log_var)) || N(0, I))`, `[]` in nats, of `[D]` inputs."""
    return kl_divergence(mean, log_var, jnp.zeros_like(mean), jnp.zeros_like(log_var))


def sample(noise: jax.Array, mean: jax.Array, log_var: jax.Array) -> jax.Array:
    """Reparameterised draw, differentiable in `mean` and `log_var`.

    Args:
      noise: `[D, ...]` standard normal numbers.
      mean: `[D, ...]`.
      log_var: `[D, ...]` logarithm of the variances.
    """
    chex.assert_shape(log_var, mean.shape, custom_message="log_var")
    chex.assert_shape(noise, mean.shape, custom_message="noise")
    return mean + jnp.exp(0.5 * log_var) * noise


def moment_match(mean: jax.Array, std: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The Gaussian with the mean and variance of an equal mixture of diagonal Gaussians.

    It minimises `E KL(component || q)` over diagonal Gaussians q, the training goal of a JMVAE's
    uni-modal encoders.

    Args:
      mean: `[K, D]` of the components.
      std: `[K, D]` of the components.

    Returns:
      `[D]` mean and `[D]` standard deviation, with variance `E[std^2] + Var[mean]`.
    """
    chex.assert_rank(mean, 2, custom_message="mean")
    chex.assert_shape(std, mean.shape, custom_message="std")
    checks.require_number("number of components", len(mean))
    checks.require_positive("std", std)
    variance = jnp.mean(std**2, axis=0) + jnp.var(mean, axis=0)
    return jnp.mean(mean, axis=0), jnp.sqrt(variance)
