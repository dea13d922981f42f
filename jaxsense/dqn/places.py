"""Random positions of a team's PoIs and robots."""

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from jaxsense.core.types import Key, pytree


@pytree
class Places:
    """Random positions: each PoI in a cell of its own, robots anywhere.

    Attributes:
      sides: `[2]` shortest and longest side of an arena, in metres.
      robot_radius: `[]` smallest distance of a robot from a wall, in metres.
      poi_pitch: smallest distance of two PoIs' centres, in metres.
      num_pois: N.
      cells_per_side: cells along a side of an arena.
    """

    sides: tuple[jax.Array | float, jax.Array | float]
    robot_radius: jax.Array | float
    poi_pitch: float = struct.field(pytree_node=False)
    num_pois: int = struct.field(pytree_node=False)
    cells_per_side: int = struct.field(pytree_node=False)

    def draw(self, key: Key, num_robots: int) -> tuple[Float[Array, "N 2"], Float[Array, "R 3"]]:
        """Draws an arena.

        Args:
          key: random key.
          num_robots: R; static.

        Returns:
          `[N, 2]` positions of the PoIs, in metres, and `[R, 3]` poses of the robots.
        """
        num_pois, per_side = self.num_pois, self.cells_per_side
        draws = jax.random.uniform(key, (1 + per_side**2 + 2 * num_pois + 3 * num_robots,))
        side = self.sides[0] + (self.sides[1] - self.sides[0]) * draws[0]
        order, draws = draws[1 : 1 + per_side**2], draws[1 + per_side**2 :]
        cell = jnp.argsort(order)[:num_pois]
        corner = jnp.stack([cell // per_side, cell % per_side], axis=-1).astype(side.dtype)
        play = jnp.maximum(side / per_side - self.poi_pitch, 0.0)
        jitter = play * (draws[: 2 * num_pois].reshape(num_pois, 2) - 0.5)
        positions = (corner + 0.5) * side / per_side - side / 2 + jitter
        places = 2 * draws[2 * num_pois :].reshape(num_robots, 3) - 1
        reach = side / 2 - self.robot_radius
        poses = jnp.concatenate([reach * places[:, :2], jnp.pi * places[:, 2:]], axis=-1)
        return positions, poses
