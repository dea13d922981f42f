"""How good a latent space is: the metrics of a run's summary, and what a belief says of a class."""

import chex
import jax
import jax.numpy as jnp
import numpy as np

from jaxsense.config import values
from jaxsense.types import Belief
from jaxsense.vae.gaussian import moment_match

ACTIVE_VARIANCE = 0.01
PLAUSIBLE_DISTANCE = 2.0


def sigma_norm(std: jax.Array) -> jax.Array:
    """`||sigma||_2` of `[..., D]` standard deviations: what the paper's Fig. 4 shows as colour."""
    chex.assert_shape(std, (..., None), custom_message="std")
    values.require_positive("std", std)
    return jnp.linalg.norm(std, axis=-1)


def active_units(mean: jax.Array) -> jax.Array:
    """`[]` int32, latent dimensions in use: those whose `[S, D]` posterior means vary.

    A dimension counts when the variance of the means over the data exceeds 0.01 (Burda, Grosse and
    Salakhutdinov 2016, Sec. 5.2).
    """
    chex.assert_rank(mean, 2, custom_message="mean")
    return jnp.sum(jnp.var(mean, axis=0) > ACTIVE_VARIANCE)


def plausible_classes(belief: Belief, class_means: jax.Array) -> jax.Array:
    """Which classes a belief leaves open.

    Args:
      belief: `[D]`.
      class_means: `[C, D]` mean of the joint posterior of each class.

    Returns:
      `[C]` bool: the class's mean is at most two standard deviations away. The nearest is always
      one of them, so that a belief between everything still names a class.
    """
    _check_belief(belief, class_means)
    distance = jnp.linalg.norm((class_means - belief.mean[None]) / belief.std[None], axis=-1)
    return (distance <= PLAUSIBLE_DISTANCE) | (distance <= jnp.min(distance))


def nearest_class(belief: Belief, class_means: jax.Array) -> jax.Array:
    """`[]` int32, the class whose joint mean is nearest to a belief's mean."""
    _check_belief(belief, class_means)
    return jnp.argmin(jnp.linalg.norm(class_means - belief.mean[None], axis=-1))


def _check_belief(belief: Belief, class_means: jax.Array) -> None:
    chex.assert_rank(belief.mean, 1, custom_message="belief.mean")
    chex.assert_shape(belief.std, belief.mean.shape, custom_message="belief.std")
    chex.assert_shape(class_means, (None, *belief.mean.shape), custom_message="class_means")
    values.require_finite("belief.mean", belief.mean)
    values.require_finite("class_means", class_means)
    values.require_positive("belief.std", belief.std)


def unambiguous(belief: Belief, class_means: jax.Array, true_class: jax.Array) -> jax.Array:
    """`[]` bool: a belief leaves open its true class and no other (the paper's Table I)."""
    plausible = plausible_classes(belief, class_means)
    return plausible[true_class] & (jnp.sum(plausible) == 1)


def moment_matching_error(belief: Belief, components: Belief) -> jax.Array:
    """How far a uni-modal posterior is from the best one.

    Args:
      belief: `[D]` posterior of one modality's detection.
      components: `[K, D]` the joint posteriors that are consistent with that detection.

    Returns:
      `[]` mean over the dimensions of `|mean difference|`, in matched standard deviations, plus
      `|log(std ratio)|`, against the moment-matched Gaussian of the components.
    """
    mean, std = moment_match(components.mean, components.std)
    shift = jnp.abs(belief.mean - mean) / std
    return jnp.mean(shift + jnp.abs(jnp.log(belief.std / std)))


def consistent_classes(label_of_class: tuple[int, ...]) -> np.ndarray:
    """`[C, C]` bool: classes that a modality with these labels cannot tell apart."""
    labels = np.array(label_of_class)
    return labels[:, None] == labels[None, :]
