"""Quality of predicted probabilities: likelihood, calibration error, reliability diagram."""

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int

from jaxsense.core import checks
from jaxsense.core.types import Reliability

MIN_PROBABILITY = 1e-12
_BINS = 15
_MOST = 4.0  # and its inverse: factors that are tried


def sharpness(logits: Float[Array, "L S"], labels: Int[Array, " S"]) -> Float[Array, ""]:
    """The factor on logits, of 257 from 1/4 to 4, by which the labels are the most likely.

    Its inverse is the temperature of Guo et al. 2017, Sec. 4.2.

    Args:
      logits: `[L, S]` log-probabilities of the labels, up to a constant of each look.
      labels: `[S]` int32 true labels.
    """

    def loss(factor: jax.Array) -> jax.Array:
        scaled = factor * logits
        return optax.softmax_cross_entropy_with_integer_labels(scaled, labels, 0).mean()

    each = jnp.geomspace(1 / _MOST, _MOST, 257)
    return each[jnp.argmin(jax.lax.map(loss, each))]


def negative_log_likelihood(
    probabilities: Float[Array, "S L"], labels: Int[Array, " S"]
) -> Float[Array, ""]:
    """Mean of `-log p(label)` in nats.

    Args:
      probabilities: `[S, L]` of each label.
      labels: `[S]` int32 true labels.
    """
    checks.require_shape("probabilities", probabilities, (None, None))
    checks.require_shape("labels", labels, (len(probabilities),))
    right = jnp.take_along_axis(probabilities, labels[:, None], axis=1)[:, 0]
    return -jnp.mean(jnp.log(jnp.maximum(right, MIN_PROBABILITY)))


def calibration_error(
    probabilities: Float[Array, "S L"], labels: Int[Array, " S"]
) -> Float[Array, ""]:
    """Expected calibration error of the most likely labels (Guo et al. 2017, Sec. 2).

    It is the difference between mean confidence and accuracy in a bin of `reliability`, averaged
    over all looks.

    Args:
      probabilities: `[S, L]` of each label.
      labels: `[S]` int32 true labels.
    """
    found = reliability(probabilities, labels)
    share = found.looks / len(labels)
    return jnp.sum(jnp.where(share > 0, share * jnp.abs(found.confidence - found.accuracy), 0.0))


def reliability(probabilities: Float[Array, "S L"], labels: Int[Array, " S"]) -> Reliability:
    """Points of a reliability diagram with fifteen bins of equal width.

    Args:
      probabilities: `[S, L]` of each label.
      labels: `[S]` int32 true labels.
    """
    checks.require_shape("probabilities", probabilities, (None, None))
    checks.require_shape("labels", labels, (len(probabilities),))
    confidence = jnp.max(probabilities, axis=1)
    is_right = jnp.argmax(probabilities, axis=1) == labels
    bins = jnp.clip(jnp.ceil(confidence * _BINS).astype(jnp.int32) - 1, 0, _BINS - 1)
    of_looks = jnp.stack([confidence, is_right, jnp.ones(len(labels))])
    sums = jnp.zeros((3, _BINS)).at[:, bins].add(of_looks)
    return Reliability(sums[0] / sums[2], sums[1] / sums[2], sums[2])
