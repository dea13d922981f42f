"""Exact Bayes over the classes, and the product of experts, to compare fusion with."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxsense.core import checks
from jaxsense.core.types import Belief, pytree

_MIN_PROBABILITY = 1e-12
_MIN_PRECISION = 1e-6

_Features = Float[Array, " D_m"]
_Labels = Int[Array | np.ndarray, " C"]


def log_likelihoods(features: _Features, label_of_class: _Labels) -> Float[Array, " C"]:
    """Log-likelihood of each class given one look, up to a constant.

    In the detector's training each label was as frequent as the classes that have it, so
    `p(x | class) ~ p(label | x) / p(label)`.

    Args:
      features: `[D_m]` probabilities of the labels.
      label_of_class: `[C]` int32.

    Raises:
      ValueError: if a label does not exist or the features are not probabilities.
    """
    chex.assert_rank([features, label_of_class], 1)
    checks.require_index("label_of_class", label_of_class, len(features))
    checks.require_probabilities("features", features)
    label_of_class = jnp.asarray(label_of_class)
    prior = jnp.zeros(len(features)).at[label_of_class].add(1 / len(label_of_class))
    ratio = jnp.maximum(features[label_of_class], _MIN_PROBABILITY) / prior[label_of_class]
    return jnp.log(ratio)


def bayes_update(
    log_weights: Float[Array, " C"],
    features: _Features,
    label_of_class: _Labels,
    weight: Float[Array, ""] | float = 1.0,
) -> Float[Array, " C"]:
    """Exact posterior over the classes after one more look.

    Args:
      log_weights: `[C]` logarithms of the classes' probabilities before the look.
      features: see `log_likelihoods`.
      label_of_class: see `log_likelihoods`.
      weight: share of the look that is new evidence, see `vae.Novelty`.

    Returns:
      `[C]` logarithms after the look, normalised.

    Raises:
      ValueError: if all classes are excluded or a logarithm is NaN; see also `log_likelihoods`.
    """
    checks.require_shape("log_weights", log_weights, (None,))
    chex.assert_equal_shape([log_weights, label_of_class])
    # Rejects -inf (all classes excluded) and NaN.
    checks.require_finite("largest of log_weights", jnp.max(log_weights))
    found = log_likelihoods(features, label_of_class)
    return jax.nn.log_softmax(log_weights + weight * found)


@pytree
class Bayes:
    """Exact Bayes over the classes; `labels` `[M, C]` int32 of each class in each modality."""

    labels: Int[Array, "M C"]

    @property
    def prior(self) -> Float[Array, " C"]:
        """Logarithms of equal probabilities."""
        number = self.labels.shape[1]
        return jnp.full(number, -jnp.log(number), jnp.float32)

    def log_likelihoods(self, features: _Features, modality: int) -> Float[Array, " C"]:
        """See the function `log_likelihoods`; `modality` is static."""
        return log_likelihoods(features, self.labels[modality])

    def update(
        self,
        log_posterior: Float[Array, " C"],
        features: _Features,
        modality: int,
        weight: Float[Array, ""] | float = 1.0,
    ) -> Float[Array, " C"]:
        """See `bayes_update`; `modality` is static."""
        return bayes_update(log_posterior, features, self.labels[modality], weight)


def product_of_experts(belief: Belief, posterior: Belief, prior: Belief) -> Belief:
    """Multiplies a belief by the posterior of one more look and divides by their common prior.

    Args:
      belief: `[D]` before the look.
      posterior: `[D]` posterior `q(z | x)` given this look alone.
      prior: `[D]`, contained in both.

    Returns:
      `[D]` normalised product, with a lower bound on its precision.

    Raises:
      ValueError: if a belief is not finite, or a standard deviation is not positive.
    """
    for name, each in (("belief", belief), ("posterior", posterior), ("prior", prior)):
        checks.require_belief(name, each, None if each is belief else len(belief.mean))
    of_belief, of_posterior, of_prior = (x.std**-2 for x in (belief, posterior, prior))
    precision = jnp.maximum(of_belief + of_posterior - of_prior, _MIN_PRECISION)
    total = of_belief * belief.mean + of_posterior * posterior.mean - of_prior * prior.mean
    return Belief(total / precision, precision**-0.5)
