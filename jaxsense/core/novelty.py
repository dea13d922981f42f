"""How much of a look is new evidence, after earlier looks from places nearby.

Looks at a PoI from one place share its light and the beams that graze an edge, so each says less
than the one before. Fusion weighs the log-likelihoods of a look by

    (1 + a sum_k exp(-d_k^2 / (2 L^2)))^-2

with d_k the distances from earlier looks by the same sensor at the PoI. A mean of k measurements
whose errors have a correlation r is worth `k / (1 + (k - 1) r)` independent ones; the weights
follow its increments closely, with an `a` for each r. Both numbers are learned from repeated looks.
"""

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxsense.core.types import Index, pytree

LEAST_NEW = 0.5
"""The share of a look that must be new evidence where a robot looks again."""
_STRENGTHS = np.append(0.0, np.geomspace(0.05, 20.0, 25)).astype(np.float32)
_LENGTHS = np.geomspace(0.03, 3.0, 17).astype(np.float32)  # m
_TOLERANCE = 0.0025  # of mean confidence above accuracy
_SAME_PLACE = 0.02  # m
_PENALTY = 10.0  # nats, above any difference of likelihoods
_FAR = 1e3  # m, where no look has been


@pytree
class Novelty:
    """The share of a look that is new evidence, for each modality.

    Attributes:
      strength: `[M]` a, how much looks from one place have in common; 0 if nothing.
      length: `[M]` L, in metres; looks from places much farther apart are independent.
    """

    strength: Float[Array, " M"]
    length: Float[Array, " M"]

    def weight(self, apart: Float[Array, "*S K"], modality: Index) -> Float[Array, "*S"]:
        """Shares of looks that are new evidence, above 0 and up to 1.

        Args:
          apart: distances from K earlier looks by this sensor at the PoI, in metres; infinite for
            none.
        """
        return _weight(apart, self.strength[modality], self.length[modality])

    def to_go(self, apart: Float[Array, "*S K"], modality: Index) -> Float[Array, "*S"]:
        """Metres to where at least `LEAST_NEW` of a look is new; 0 where it is already.

        Straight away from the earlier looks, as if all that count were at the nearest one; for
        `apart` see `weight`.
        """
        strength, length = self.strength[modality], self.length[modality]
        apart = jnp.minimum(apart, _FAR)
        nearest = jnp.min(apart, axis=-1)
        number = jnp.sum(jnp.exp(0.5 * (nearest[..., None] ** 2 - apart**2) / length**2), axis=-1)
        # The term `a sum_k ...` of the weight where just `LEAST_NEW` is new.
        ratio = strength * number / (LEAST_NEW**-0.5 - 1)
        reach = length * jnp.sqrt(2 * jnp.log(jnp.maximum(ratio, 1.0)))
        return jnp.maximum(reach - nearest, 0.0)


def independent(num_modalities: int) -> Novelty:
    """All of every look is new evidence."""
    return Novelty(jnp.zeros(num_modalities), jnp.ones(num_modalities))


def fit(
    found: Float[Array, "S T C"], positions: Float[Array, "S T 2"], classes: Int[Array, " S"]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """`strength` and `length` of `Novelty` from repeated looks by one sensor, on a grid.

    The maximum likelihood of the true classes among those for which the mean confidence after two
    and more looks exceeds the accuracy by at most .0025, both from one place and from several:
    likelihoods alone accept too much confidence in looks that repeat an error.

    Args:
      found: log-likelihoods of the classes given each of T looks at a PoI.
      positions: places of the looks, in metres.
      classes: true classes.
    """
    chex.assert_rank([found, classes], [3, 1])
    chex.assert_shape(positions, (*found.shape[:2], 2))
    apart = jnp.linalg.norm(positions[:, :, None] - positions[:, None], axis=-1)
    is_earlier = np.tri(found.shape[1], k=-1, dtype=bool)
    is_one_place = jnp.max(apart, axis=(1, 2)) < _SAME_PLACE
    groups = jnp.stack([is_one_place, ~is_one_place])
    numbers = jnp.maximum(jnp.sum(groups, axis=1), 1) * (found.shape[1] - 1)
    apart = jnp.where(is_earlier[None], apart, jnp.inf)
    strength, length = (jnp.asarray(x.reshape(-1)) for x in np.meshgrid(_STRENGTHS, _LENGTHS))

    def loss(candidate: tuple[jax.Array, jax.Array]) -> jax.Array:
        weights = _weight(apart, candidate[0], candidate[1])
        log_posterior = jax.nn.log_softmax(jnp.cumsum(weights[..., None] * found, axis=1))
        of_truth = jnp.take_along_axis(log_posterior, classes[:, None, None], axis=2)[:, 1:, 0]
        # Classes that the sensor cannot tell apart are equally likely.
        least = jnp.max(log_posterior[:, 1:], axis=-1, keepdims=True) - 1e-5
        of_most_likely = jnp.where(log_posterior[:, 1:] >= least, jnp.exp(log_posterior[:, 1:]), 0)
        surer = jnp.sum(of_most_likely, axis=-1) - (of_truth >= least[..., 0])
        excess = jnp.sum(groups * jnp.sum(surer, axis=1)[None], axis=1) / numbers
        return _PENALTY * jnp.sum(jnp.maximum(excess - _TOLERANCE, 0.0)) - jnp.mean(of_truth)

    best = jnp.argmin(jax.lax.map(loss, (strength, length)))
    return strength[best], length[best]


def _weight(apart: jax.Array, strength: jax.Array, length: jax.Array) -> jax.Array:
    near = jnp.sum(jnp.exp(-0.5 * (apart / length) ** 2), axis=-1)
    return (1 + strength * near) ** -2
