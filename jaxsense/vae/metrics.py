"""Metrics of a latent space for a run's summary, and the classes that a belief leaves open."""

import chex
import jax
import jax.numpy as jnp
import numpy as np

from jaxsense.core import checks
from jaxsense.core.types import Belief
from jaxsense.vae.gaussian import moment_match

ACTIVE_VARIANCE = 0.01
PLAUSIBLE_DISTANCE = 2.0
LEAST_PROBABILITY = 1e-12
_BINS = 15


def sigma_norm(std: jax.Array) -> jax.Array:
    """`||sigma||_2` of `[..., D]` standard deviations, the colour in the paper's Fig. 4."""
    chex.assert_shape(std, (..., None), custom_message="std")
    checks.require_positive("std", std)
    return jnp.linalg.norm(std, axis=-1)


def active_units(mean: jax.Array) -> jax.Array:
    """Number of latent dimensions in use, `[]` int32.

    A dimension counts when the variance of its `[S, D]` posterior means over the data exceeds 0.01
    (Burda, Grosse and Salakhutdinov 2016, Sec. 5.2).
    """
    chex.assert_rank(mean, 2, custom_message="mean")
    return jnp.sum(jnp.var(mean, axis=0) > ACTIVE_VARIANCE)


def plausible_classes(belief: Belief, class_means: jax.Array) -> jax.Array:
    """Classes that a belief leaves open.

    Args:
      belief: `[D]`.
      class_means: `[C, D]` mean of the joint posterior of each class.

    Returns:
      `[C]` bool: the class's mean is at most two standard deviations away, or the nearest, so that
      a belief far from all classes still names one.
    """
    _check_belief(belief, class_means)
    distance = jnp.linalg.norm((class_means - belief.mean[None]) / belief.std[None], axis=-1)
    return (distance <= PLAUSIBLE_DISTANCE) | (distance <= jnp.min(distance))


def nearest_class(belief: Belief, class_means: jax.Array) -> jax.Array:
    """Class whose joint mean is nearest to a belief's mean, `[]` int32."""
    _check_belief(belief, class_means)
    return jnp.argmin(jnp.linalg.norm(class_means - belief.mean[None], axis=-1))


def _check_belief(belief: Belief, class_means: jax.Array) -> None:
    chex.assert_rank(belief.mean, 1, custom_message="belief.mean")
    chex.assert_shape(belief.std, belief.mean.shape, custom_message="belief.std")
    chex.assert_shape(class_means, (None, *belief.mean.shape), custom_message="class_means")
    checks.require_finite("belief.mean", belief.mean)
    checks.require_finite("class_means", class_means)
    checks.require_positive("belief.std", belief.std)


def negative_log_likelihood(probabilities: jax.Array, labels: jax.Array) -> jax.Array:
    """Mean of `-log p(label)`, `[]` in nats.

    Args:
      probabilities: `[S, L]` of each label.
      labels: `[S]` int32 true labels.
    """
    chex.assert_rank(probabilities, 2, custom_message="probabilities")
    chex.assert_shape(labels, (len(probabilities),), custom_message="labels")
    right = jnp.take_along_axis(probabilities, labels[:, None], axis=1)[:, 0]
    return -jnp.mean(jnp.log(jnp.maximum(right, LEAST_PROBABILITY)))


def calibration_error(probabilities: jax.Array, labels: jax.Array) -> jax.Array:
    """Expected calibration error of the most likely labels, `[]` (Guo et al. 2017, Sec. 2).

    The mean over all looks of the difference between the mean confidence of a bin of
    `reliability` and its share of right labels.

    Args:
      probabilities: `[S, L]` of each label.
      labels: `[S]` int32 true labels.
    """
    confidence, accuracy, share = reliability(probabilities, labels)
    return jnp.sum(jnp.where(share > 0, share * jnp.abs(confidence - accuracy), 0.0))


def reliability(
    probabilities: jax.Array, labels: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The points of a reliability diagram: fifteen bins of equal width hold looks by confidence.

    Args:
      probabilities: `[S, L]` of each label.
      labels: `[S]` int32 true labels.

    Returns:
      For each bin its mean confidence and its share of right labels, NaN if it is empty, and its
      share of all looks.
    """
    chex.assert_rank(probabilities, 2, custom_message="probabilities")
    chex.assert_shape(labels, (len(probabilities),), custom_message="labels")
    confidence = jnp.max(probabilities, axis=1)
    is_right = jnp.argmax(probabilities, axis=1) == labels
    bins = jnp.clip(jnp.ceil(confidence * _BINS).astype(jnp.int32) - 1, 0, _BINS - 1)
    of_looks = jnp.stack([confidence, is_right, jnp.ones(len(labels))])
    sums = jnp.zeros((3, _BINS)).at[:, bins].add(of_looks)
    return sums[0] / sums[2], sums[1] / sums[2], sums[2] / len(labels)


def moment_matching_error(belief: Belief, components: Belief) -> jax.Array:
    """Distance of a uni-modal posterior from the best one.

    Args:
      belief: `[D]` posterior of one modality's detection.
      components: `[K, D]` joint posteriors that are consistent with the detection.

    Returns:
      `[]` mean over the dimensions of `|mean difference|`, in matched standard deviations, plus
      `|log(std ratio)|`, against the moment-matched Gaussian of the components.
    """
    mean, std = moment_match(components.mean, components.std)
    shift = jnp.abs(belief.mean - mean) / std
    return jnp.mean(shift + jnp.abs(jnp.log(belief.std / std)))


def consistent_classes(label_of_class: tuple[int, ...]) -> np.ndarray:
    """Pairs of classes, `[C, C]` bool, that a modality with these labels cannot distinguish."""
    labels = np.array(label_of_class)
    return labels[:, None] == labels[None, :]
