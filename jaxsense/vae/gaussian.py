"""Diagonal Gaussians: divergence, sampling, products and moment matching."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsense.core import checks

_Row = Float[Array, " D"]
_Columns = Float[Array, "D ..."]


def kl_divergence(mean_p: _Row, log_var_p: _Row, mean_q: _Row, log_var_q: _Row) -> Float[Array, ""]:
    """Computes the Kullback-Leibler divergence `KL(p || q)` of two diagonal Gaussians.

    Args:
      mean_p: `[D]`.
      log_var_p: `[D]` logarithm of the variances.
      mean_q: `[D]`.
      log_var_q: `[D]`.

    Returns:
      `[]` in nats.
    """
    checks.require_shape("mean_p", mean_p, (None,))
    checks.require_shape("log_var_p", log_var_p, mean_p.shape)
    checks.require_shape("mean_q", mean_q, mean_p.shape)
    checks.require_shape("log_var_q", log_var_q, mean_p.shape)
    ratio = jnp.exp(log_var_p - log_var_q)
    distance = (mean_p - mean_q) ** 2 * jnp.exp(-log_var_q)
    return 0.5 * jnp.sum(ratio + distance - 1.0 - log_var_p + log_var_q)


def kl_to_standard_normal(mean: _Row, log_var: _Row) -> Float[Array, ""]:
    """Divergence `KL(N(mean, exp(log_var)) || N(0, I))`.

    Args:
      mean: `[D]`.
      log_var: `[D]` logarithm of the variances.

    Returns:
      `[]` in nats.
    """
    return kl_divergence(mean, log_var, jnp.zeros_like(mean), jnp.zeros_like(log_var))


def sample(noise: _Columns, mean: _Columns, log_var: _Columns) -> Float[Array, "D ..."]:
    """Reparameterised draw, differentiable in `mean` and `log_var`.

    Args:
      noise: `[D, ...]` standard normal draws.
      mean: `[D, ...]`.
      log_var: `[D, ...]` logarithm of the variances.
    """
    checks.require_shape("mean", mean, (...,))
    checks.require_shape("log_var", log_var, mean.shape)
    checks.require_shape("noise", noise, mean.shape)
    return mean + jnp.exp(0.5 * log_var) * noise


def product(
    means: Float[Array, "K D"], log_vars: Float[Array, "K D"]
) -> tuple[Float[Array, " D"], Float[Array, " D"]]:
    """Posterior given several observations, `p(z) prod_k q_k(z) / p(z)` with a standard normal p.

    It is exact if the observations are independent given z. No factor counts as wider than the
    prior, because an observation cannot take away what others tell.

    Args:
      means: `[K, D]` of the posteriors given one observation each.
      log_vars: `[K, D]` logarithms of their variances.

    Returns:
      `[D]` mean and `[D]` log-variance.
    """
    checks.require_shape("means", means, (None, None))
    checks.require_shape("log_vars", log_vars, means.shape)
    precisions = jnp.exp(-jnp.minimum(log_vars, 0.0))
    precision = 1.0 + jnp.sum(precisions - 1.0, axis=0)
    return jnp.sum(precisions * means, axis=0) / precision, -jnp.log(precision)


def moment_match(
    mean: Float[Array, "K D"], std: Float[Array, "K D"]
) -> tuple[Float[Array, " D"], Float[Array, " D"]]:
    """Computes mean and standard deviation of an equal mixture of diagonal Gaussians.

    The Gaussian with these moments minimises `E KL(component || q)` over diagonal Gaussians q, the
    training goal of a JMVAE's uni-modal encoders.

    Args:
      mean: `[K, D]` of the components.
      std: `[K, D]` of the components.

    Returns:
      `[D]` mean and `[D]` standard deviation, with variance `E[std^2] + Var[mean]`.

    Raises:
      ValueError: if there is no component, or a standard deviation is not positive.
    """
    checks.require_shape("mean", mean, (None, None))
    checks.require_shape("std", std, mean.shape)
    checks.require_number("number of components", len(mean))
    checks.require_positive("std", std)
    variance = jnp.mean(std**2, axis=0) + jnp.var(mean, axis=0)
    return jnp.mean(mean, axis=0), jnp.sqrt(variance)
