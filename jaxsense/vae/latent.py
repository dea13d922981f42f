"""Metrics of a latent space, and the classes that are plausible given a belief."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxsense.core import checks
from jaxsense.core.types import Belief
from jaxsense.vae.gaussian import moment_match

ACTIVE_VARIANCE = 0.01
PLAUSIBLE_DISTANCE = 2.0


def sigma_norm(std: Float[Array, "*S D"]) -> Float[Array, "*S"]:
    """Norm `||sigma||_2` of `[..., D]` standard deviations.

    The colour in the paper's Fig. 4.

    Raises:
      ValueError: if a standard deviation is not positive.
    """
    checks.require_shape("std", std, (..., None))
    checks.require_positive("std", std)
    return jnp.linalg.norm(std, axis=-1)


def active_units(mean: Float[Array, "S D"]) -> Int[Array, ""]:
    """Number of latent dimensions in use, int32.

    A dimension counts when the variance of its `[S, D]` posterior means over the data exceeds 0.01
    (Burda, Grosse and Salakhutdinov 2016, Sec. 5.2).
    """
    checks.require_shape("mean", mean, (None, None))
    return jnp.sum(jnp.var(mean, axis=0) > ACTIVE_VARIANCE)


def plausible_classes(belief: Belief, class_means: Float[Array, "C D"]) -> Bool[Array, " C"]:
    """Marks the classes that are plausible given a belief.

    Args:
      belief: `[D]`.
      class_means: `[C, D]` mean of the joint posterior of each class.

    Returns:
      `[C]` bool: classes whose mean is at most two standard deviations away, and the nearest one,
      so that some class is always plausible.

    Raises:
      ValueError: if an argument is not finite, or a standard deviation is not positive.
    """
    _check_belief(belief, class_means)
    distance = jnp.linalg.norm((class_means - belief.mean[None]) / belief.std[None], axis=-1)
    return (distance <= PLAUSIBLE_DISTANCE) | (distance <= jnp.min(distance))


def nearest_class(belief: Belief, class_means: Float[Array, "C D"]) -> Int[Array, ""]:
    """Returns the class whose mean is nearest to the mean of a belief, int32.

    Args:
      belief: `[D]`.
      class_means: `[C, D]` mean of the joint posterior of each class.

    Raises:
      ValueError: if an argument is not finite, or a standard deviation is not positive.
    """
    _check_belief(belief, class_means)
    return jnp.argmin(jnp.linalg.norm(class_means - belief.mean[None], axis=-1))


def _check_belief(belief: Belief, class_means: jax.Array) -> None:
    """Raises an error unless shapes fit and values describe Gaussians."""
    checks.require_belief("belief", belief)
    checks.require_shape("class_means", class_means, (None, *belief.mean.shape))
    checks.require_finite("class_means", class_means)


def moment_matching_error(belief: Belief, components: Belief) -> Float[Array, ""]:
    """Distance of a uni-modal posterior from the best possible one.

    Args:
      belief: `[D]` posterior of one modality's detection.
      components: `[K, D]` joint posteriors of the classes that are consistent with the detection.

    Returns:
      `[]` mean over the dimensions of `|mean difference|`, in matched standard deviations, plus
      `|log(std ratio)|`, against the moment-matched Gaussian of the components.
    """
    mean, std = moment_match(components.mean, components.std)
    shift = jnp.abs(belief.mean - mean) / std
    return jnp.mean(shift + jnp.abs(jnp.log(belief.std / std)))


def consistent_classes(label_of_class: tuple[int, ...]) -> Bool[np.ndarray, "C C"]:
    """Pairs of classes that a modality with these labels of the classes cannot distinguish."""
    labels = np.array(label_of_class)
    return labels[:, None] == labels[None, :]
