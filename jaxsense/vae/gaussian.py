"""Diagonal Gaussians: divergence, draws, products and moment matching."""

import chex
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsense.core import checks

_Columns = Float[Array, "D ..."]


def kl_divergence(
    mean_p: _Columns,
    log_var_p: _Columns,
    mean_q: _Columns | float = 0.0,
    log_var_q: _Columns | float = 0.0,
) -> Float[Array, "..."]:
    """Kullback-Leibler divergence `KL(p || q)` of `[D, ...]` Gaussians, `[...]` in nats.

    By default q is a standard normal. `log_var` are logarithms of variances; axes after the first
    broadcast.
    """
    chex.assert_equal_shape([mean_p, log_var_p])
    ratio = jnp.exp(log_var_p - log_var_q)
    distance = (mean_p - mean_q) ** 2 * jnp.exp(-jnp.asarray(log_var_q))
    return 0.5 * jnp.sum(ratio + distance - 1.0 - log_var_p + log_var_q, axis=0)


def sample(noise: _Columns, mean: _Columns, log_var: _Columns) -> Float[Array, "D ..."]:
    """Reparameterised draw from standard normal `noise`, differentiable in `mean` and `log_var`."""
    chex.assert_equal_shape([noise, mean, log_var])
    return mean + jnp.exp(0.5 * log_var) * noise


def product(
    means: Float[Array, "K D"], log_vars: Float[Array, "K D"]
) -> tuple[Float[Array, " D"], Float[Array, " D"]]:
    """Posterior given K observations, `p(z) prod_k q_k(z) / p(z)` with a standard normal p.

    Exact if the observations are independent given z. No factor counts as wider than the prior:
    an observation cannot take away what others tell.

    Returns:
      Mean and log-variance.
    """
    chex.assert_rank(means, 2)
    chex.assert_equal_shape([means, log_vars])
    precisions = jnp.exp(-jnp.minimum(log_vars, 0.0))
    precision = 1.0 + jnp.sum(precisions - 1.0, axis=0)
    return jnp.sum(precisions * means, axis=0) / precision, -jnp.log(precision)


def moment_match(
    mean: Float[Array, "K D"], std: Float[Array, "K D"]
) -> tuple[Float[Array, " D"], Float[Array, " D"]]:
    """Mean and standard deviation of an equal mixture of K diagonal Gaussians.

    The Gaussian with these moments minimises `E KL(component || q)` over diagonal Gaussians q, the
    goal of a JMVAE's uni-modal encoders.
    """
    checks.require_positive("std", std)
    chex.assert_rank(mean, 2)
    chex.assert_equal_shape([mean, std])
    checks.require_number("number of components", len(mean))
    variance = jnp.mean(std**2, axis=0) + jnp.var(mean, axis=0)
    return jnp.mean(mean, axis=0), jnp.sqrt(variance)
