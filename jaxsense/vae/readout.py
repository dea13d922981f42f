"""Class probabilities as a belief, and read from a belief.

The Gaussian with the moments of the mixture `sum_c w_c q*_c` of the classes' joint posteriors holds
the probabilities `w_c`: its mean and mean square are linear in them.
"""

import chex
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsense.core import checks
from jaxsense.core.types import Belief

MIN_PROBABILITY = 1e-5
"""Smallest probability of a class that a belief can hold in float32."""


def mixture(classes: Belief, probabilities: Float[Array, " C"]) -> Belief:
    """Gaussian with the moments of a mixture of the classes.

    Args:
      classes: `[C, D]` joint posterior of each class.
      probabilities: `[C]` of sum 1.

    Returns:
      `[D]` belief.

    Raises:
      ValueError: if `probabilities` are not within 0 and 1, or their sum is not 1.
    """
    chex.assert_shape(probabilities, classes.mean.shape[:1], custom_message="probabilities")
    checks.require_probabilities("probabilities", probabilities)
    mean = probabilities @ classes.mean
    spread = classes.std**2 + (classes.mean - mean[None]) ** 2
    return Belief(mean, jnp.sqrt(probabilities @ spread))


def readout_matrix(classes: Belief) -> Float[Array, "C K"]:
    """Linear map from the moments of a mixture to its weights.

    With more than `2D + 1` classes, moments do not determine weights; the map returns the weights
    of smallest norm.

    Args:
      classes: `[C, D]` joint posterior of each class.

    Returns:
      `[C, 2D + 1]`.
    """
    return jnp.linalg.pinv(_moments(classes).T)


def class_probabilities(
    matrix: Float[Array, "C K"], prior: Belief, belief: Belief
) -> Float[Array, " C"]:
    """Probability of each class according to a belief.

    Args:
      matrix: `[C, 2D + 1]` from `readout_matrix`.
      prior: `[D]` belief before any look, in which all classes are equally likely.
      belief: `[D]`.

    Returns:
      `[C]` probabilities, each at least about `MIN_PROBABILITY`.

    Raises:
      ValueError: if the belief is not finite, or a standard deviation is not positive.
    """
    checks.require_finite("belief.mean", belief.mean)
    checks.require_positive("belief.std", belief.std)
    found = jnp.maximum(matrix @ _moments(belief), MIN_PROBABILITY)
    apart = jnp.maximum(jnp.abs(belief.mean - prior.mean), jnp.abs(belief.std - prior.std))
    # Tolerates rounding between compiled programs.
    is_prior = jnp.all(apart <= 1e-5 * prior.std)
    return jnp.where(is_prior, 1 / len(found), found / jnp.sum(found))


def _moments(belief: Belief) -> Float[Array, "... K"]:
    """Mean, mean square, and 1, `[..., 2D + 1]`: all linear in the weights of a mixture."""
    square = belief.std**2 + belief.mean**2
    one = jnp.ones((*belief.mean.shape[:-1], 1))
    return jnp.concatenate([belief.mean, square, one], axis=-1)
