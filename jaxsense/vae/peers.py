"""Other ways to fuse looks, to compare with: exact Bayes over the classes, product of experts."""

import chex
import jax
import jax.numpy as jnp

from jaxsense.core import checks
from jaxsense.core.types import Belief
from jaxsense.vae.metrics import LEAST_PROBABILITY

_LEAST_PRECISION = 1e-6


def log_likelihoods(features: jax.Array, label_of_class: jax.Array) -> jax.Array:
    """How likely each class makes a look, from a detector's probabilities.

    Labels were as frequent in the detector's training as classes that have them, so
    `p(x | class) ~ p(label | x) / p(label)`.

    Args:
      features: `[D_m]` probabilities of the labels.
      label_of_class: `[C]` int32, the label of each class in this modality.

    Returns:
      `[C]` logarithms of the likelihoods, but for a constant.
    """
    chex.assert_rank(features, 1, custom_message="features")
    chex.assert_rank(label_of_class, 1, custom_message="label_of_class")
    checks.require_index("label_of_class", label_of_class, len(features))
    checks.require_probabilities("features", features)
    label_of_class = jnp.asarray(label_of_class)
    prior = jnp.zeros(len(features)).at[label_of_class].add(1 / len(label_of_class))
    ratio = jnp.maximum(features[label_of_class], LEAST_PROBABILITY) / prior[label_of_class]
    return jnp.log(ratio)


def bayes_update(
    log_weights: jax.Array, features: jax.Array, label_of_class: jax.Array
) -> jax.Array:
    """Exact Bayes filter over classes, from a detector's probabilities.

    Args:
      log_weights: `[C]` logarithms of the classes' probabilities before the look.
      features: see `log_likelihoods`.
      label_of_class: see `log_likelihoods`.

    Returns:
      `[C]` logarithms after the look, normalised.
    """
    chex.assert_rank(log_weights, 1, custom_message="log_weights")
    chex.assert_shape(label_of_class, log_weights.shape, custom_message="label_of_class")
    # Infinite if no class has any weight, NaN if one is.
    checks.require_finite("largest of log_weights", jnp.max(log_weights))
    return jax.nn.log_softmax(log_weights + log_likelihoods(features, label_of_class))


def product_of_experts(belief: Belief, posterior: Belief, prior: Belief) -> Belief:
    """Multiplies a belief with the posterior of one more look, and divides by the prior.

    Args:
      belief: `[D]` before the look.
      posterior: `[D]` `q(z | x)` of the look alone.
      prior: `[D]`, contained in both.

    Returns:
      `[D]` normalised product; dimensions of no precision keep a little.
    """
    for name, each in (("belief", belief), ("posterior", posterior), ("prior", prior)):
        chex.assert_shape(each.std, each.mean.shape, custom_message=name)
        checks.require_finite(f"{name}.mean", each.mean)
        checks.require_positive(f"{name}.std", each.std)
    of_belief, of_posterior, of_prior = (x.std**-2 for x in (belief, posterior, prior))
    precision = jnp.maximum(of_belief + of_posterior - of_prior, _LEAST_PRECISION)
    total = of_belief * belief.mean + of_posterior * posterior.mean - of_prior * prior.mean
    return Belief(total / precision, precision**-0.5)
