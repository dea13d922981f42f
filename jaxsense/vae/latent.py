"""Metrics of a latent space, and the classes that a belief leaves open."""

import chex
import jax
import jax.numpy as jnp
import numpy as np

from jaxsense.core import checks
from jaxsense.core.types import Belief
from jaxsense.vae.gaussian import moment_match

ACTIVE_VARIANCE = 0.01
PLAUSIBLE_DISTANCE = 2.0


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
