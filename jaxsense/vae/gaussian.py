"""Diagonal Gaussians: divergence, draws, products and moment matching."""

import chex
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsense.core import checks
from jaxsense.core.types import Belief

_MIN_PRECISION = 1e-6
_Columns = Float[Array, "D ..."]


def kl_divergence(
    mean_p: _Columns,
    log_var_p: _Columns,
    mean_q: _Columns | float = 0.0,
    log_var_q: _Columns | float = 0.0,
) -> Float[Array, "..."]:
    """Kullback-Leibler divergence `KL(p || q)` of Gaussians, in nats.

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


def product_of_experts(belief: Belief, posterior: Belief, prior: Belief) -> Belief:
    """Multiplies a `[D]` belief by the posterior of one more look and divides by their prior.

    Args:
      belief: before the look.
      posterior: `q(z | x)` given this look alone.
      prior: contained in both.

    Returns:
      Normalised product, with a lower bound on its precision.
    """
    for name, each in (("belief", belief), ("posterior", posterior), ("prior", prior)):
        checks.require_belief(name, each, None if each is belief else len(belief.mean))
    of_belief, of_posterior, of_prior = (x.std**-2 for x in (belief, posterior, prior))
    precision = jnp.maximum(of_belief + of_posterior - of_prior, _MIN_PRECISION)
    total = of_belief * belief.mean + of_posterior * posterior.mean - of_prior * prior.mean
    return Belief(total / precision, precision**-0.5)


def moment_match(parts: Belief) -> Belief:
    """Moments of an equal mixture of `[K, D]` diagonal Gaussians, `[D]`.

    The Gaussian with these moments minimises `E KL(part || q)` over diagonal Gaussians q, the goal
    of a JMVAE's uni-modal encoders.
    """
    chex.assert_rank(parts.mean, 2)
    variance = jnp.mean(parts.std**2, axis=0) + jnp.var(parts.mean, axis=0)
    return Belief(jnp.mean(parts.mean, axis=0), jnp.sqrt(variance))
