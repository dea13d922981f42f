"""Exact Bayes over the classes, to compare fusion with."""

import chex
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxsense.core import checks
from jaxsense.core.types import pytree

_MIN_PROBABILITY = 1e-12


@pytree
class Bayes:
    """Exact Bayes over the classes; `labels` `[M, C]` int32 of each class in each modality."""

    labels: Int[Array, "M C"]

    @property
    def prior(self) -> Float[Array, " C"]:
        """Logarithms of equal probabilities."""
        number = self.labels.shape[1]
        return jnp.full(number, -jnp.log(number), jnp.float32)

    def log_likelihoods(self, features: Float[Array, " D_m"], modality: int) -> Float[Array, " C"]:
        """Log-likelihood of each class given one look, up to a constant.

        In the detector's training each label was as frequent as the classes that have it, so
        `p(x | class) ~ p(label | x) / p(label)`.

        Args:
          features: probabilities of the labels.
          modality: index of the sensor; static.

        Raises:
          ValueError: if the features are not probabilities.
        """
        chex.assert_rank(features, 1)
        checks.require_probabilities("features", features)
        labels = self.labels[modality]
        prior = jnp.zeros(len(features)).at[labels].add(1 / len(labels))
        return jnp.log(jnp.maximum(features[labels], _MIN_PROBABILITY) / prior[labels])

    def update(
        self,
        log_posterior: Float[Array, " C"],
        features: Float[Array, " D_m"],
        modality: int,
        weight: Float[Array, ""] | float = 1.0,
    ) -> Float[Array, " C"]:
        """Normalised logarithms of the classes' probabilities after one more look.

        Args:
          log_posterior: logarithms before the look.
          features: see `log_likelihoods`.
          modality: index of the sensor; static.
          weight: share of the look that is new evidence, see `vae.Novelty`.

        Raises:
          ValueError: if all classes are excluded or a logarithm is NaN; see also `log_likelihoods`.
        """
        chex.assert_shape(log_posterior, self.labels.shape[1:])
        # Rejects -inf (all classes excluded) and NaN.
        checks.require_finite("largest of log_posterior", jnp.max(log_posterior))
        found = self.log_likelihoods(features, modality)
        return jax.nn.log_softmax(log_posterior + weight * found)
