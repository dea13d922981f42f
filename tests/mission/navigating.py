"""An arena and settings for tests of navigation."""

import jax.numpy as jnp

from jaxsense import sim
from jaxsense.config.scene import ArenaConfig

ARENA = ArenaConfig()
PERIOD = 0.1  # s


def layout_of(*positions):
    """A layout with cylinders at some places and the others, of three, far outside."""
    outside = [[9.0, 9.0], [-9.0, 9.0], [9.0, -9.0]]
    position = jnp.array([*positions, *outside[len(positions) :]], jnp.float32)
    return sim.make_layout(ARENA, position, jnp.zeros(3), jnp.zeros(3, jnp.int32))
