"""Arenas with PoIs at given places, and the ways among them."""

import jax
import jax.numpy as jnp

from jaxsense import sim
from jaxsense.config import Config
from jaxsense.config.scene import ArenaConfig
from jaxsense.mission import roadmap

CONFIG = Config()
ALONE = Config(arena=ArenaConfig(num_pois=1))
# A cube of half side 0.1 reaches 0.141421 from its centre, a robot is planned with 0.1.
KEEP = 0.241421  # m
MARGIN = 0.02  # m, that ways between nodes keep beyond that
FAR_AWAY = jnp.full((1, 2), 1e3)
# With 16 sides, viewpoint n is 22.5 * n degrees around at 0.5 m, viewpoint 16 + n at 0.9 m.
EAST, NORTH, WEST, SOUTH = 0, 4, 8, 12
OUTER = 16

build = jax.jit(roadmap.build, static_argnums=0)
lengths = jax.jit(roadmap.Roadmap.lengths)


@jax.jit
def next_waypoint(ways, position, others, poi, view):
    return ways.next_waypoint(ways.to_viewpoint(poi, view), position, others, poi, view)


def planned(config, positions):
    """The ways among PoIs at some places."""
    number = len(positions)
    position, classes = jnp.array(positions, jnp.float32), jnp.zeros(number, jnp.int32)
    return build(config, sim.make_layout(config.arena, position, jnp.zeros(number), classes))
