"""How much of a look is new evidence, after earlier looks from places nearby.

Two looks at a PoI from one place share its light and the beams that graze an edge, so the second
says little that the first has not said. Fusion weighs the log-likelihoods of a look by how far the
sensor has moved, `1 - (1 - near) exp(-d^2 / (2 L^2))`: from `near` for a look from the same place
to 1 far away. Both numbers are learned from pairs of looks.
"""

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxsense.core import checks
from jaxsense.core.types import Index, pytree

_NEAR = np.linspace(0.0, 1.0, 33, dtype=np.float32)
_LENGTHS = np.geomspace(0.03, 3.0, 25, dtype=np.float32)  # m


@pytree
class Novelty:
    """The share of a look that is new evidence, for each modality.

    Attributes:
      near: `[M]` share of a look from the same place as an earlier one.
      length: `[M]` L, in metres; looks from places much farther apart are independent.
    """

    near: Float[Array, " M"]
    length: Float[Array, " M"]

    def weight(self, moved: Float[Array, "..."], modality: Index) -> Float[Array, "..."]:
        """The share of a look that is new evidence.

        Args:
          moved: `[...]` distance from the nearest earlier look by this sensor at the PoI, in
            metres; infinite if there is none.
          modality: index of the sensor.

        Returns:
          `[...]` weights from `near` to 1.
        """
        return _weight(moved, self.near[modality], self.length[modality])

    def fresh_distance(self, modality: Index) -> Float[Array, ""]:
        """Distance from an earlier look beyond which most of a look is new, in metres.

        Args:
          modality: index of the sensor.
        """
        near, length = self.near[modality], self.length[modality]
        # 1 - (1 - near) exp(-d^2 / (2 L^2)) = 1 / 2.
        return length * jnp.sqrt(2 * jnp.log(jnp.maximum(2 * (1 - near), 1.0)))


def independent(num_modalities: int) -> Novelty:
    """All of every look is new evidence.

    Args:
      num_modalities: M.
    """
    return Novelty(jnp.ones(num_modalities), jnp.ones(num_modalities))


def fit(
    first: Float[Array, "S C"],
    second: Float[Array, "S C"],
    moved: Float[Array, " S"],
    classes: Int[Array, " S"],
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Learns the weight of a second look by one sensor from pairs of looks.

    Args:
      first: `[S, C]` log-likelihoods of the classes given the first look.
      second: `[S, C]` the same given the second look.
      moved: `[S]` distance between the places of the two, in metres.
      classes: `[S]` int32 true classes.

    Returns:
      `[]` `near` and `[]` `length` of `Novelty`, on a grid, for which the true classes are most
      likely.

    Raises:
      ValueError: if a distance is negative or a class does not exist.
    """
    chex.assert_equal_shape([first, second], custom_message="first, second")
    chex.assert_shape([moved, classes], (len(first),), custom_message="moved, classes")
    checks.require("moved", moved, lambda x: x >= 0, "must be at least 0")
    checks.require_index("classes", classes, first.shape[1])
    near, length = (jnp.asarray(x.reshape(-1)) for x in np.meshgrid(_NEAR, _LENGTHS))

    def loss(of: tuple[jax.Array, jax.Array]) -> jax.Array:
        near, length = of
        found = first + _weight(moved, near, length)[:, None] * second
        right = jnp.take_along_axis(jax.nn.log_softmax(found), classes[:, None], axis=1)
        return -jnp.mean(right)

    best = jnp.argmin(jax.lax.map(loss, (near, length)))
    return near[best], length[best]


def _weight(moved: jax.Array, near: jax.Array, length: jax.Array) -> jax.Array:
    return 1 - (1 - near) * jnp.exp(-0.5 * (moved / length) ** 2)
