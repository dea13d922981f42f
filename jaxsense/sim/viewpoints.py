"""Places from which a sensor faces a point of interest, in range and free of collision."""

import chex
import jax
import jax.numpy as jnp
import numpy as np

from jaxsense.config import ArenaConfig, ViewpointConfig
from jaxsense.core.types import Key
from jaxsense.sim import amiro
from jaxsense.sim.arena import Layout

NUM_CANDIDATES = 16


def random_viewpoint(
    key: Key,
    config: ViewpointConfig,
    arena: ArenaConfig,
    layout: Layout,
    others: jax.Array,
    poi: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """Draws a pose from which a robot looks at a PoI.

    Candidates are uniform in distance and direction. The first one wins that is free and sees the
    PoI past the other PoIs and robots; if there is none, the one with the most room.

    Args:
      key: random key.
      config: distances, bearings and clearance.
      arena: sizes of arena and PoIs.
      layout: where the PoIs stand.
      others: `[K, 2]` positions of the other robots, in metres.
      poi: `[]` int32 index of the PoI to look at.

    Returns:
      `[3]` pose x [m], y [m], yaw [rad], and `[]` the PoI's believed bearing in the robot's frame,
      in radians.
    """
    chex.assert_shape(others, (None, 2), custom_message="others")
    chex.assert_rank(poi, 0, custom_message="poi")
    # One draw for everything: each use of the random generator takes long to compile.
    draws = jax.random.uniform(key, (2 * NUM_CANDIDATES + 2,), jnp.float32)
    near, far = config.min_distance, config.max_distance
    distance = near + (far - near) * draws[:NUM_CANDIDATES]
    side = jnp.pi * (2 * draws[NUM_CANDIDATES:-2] - 1)
    target = layout.position[poi]
    position = target[0] + distance * jnp.cos(side), target[1] + distance * jnp.sin(side)
    room = free_room(*position, config.clearance, arena, layout, others, poi)
    first_free = jnp.argmax(room > 0)
    chosen = jnp.where(jnp.any(room > 0), first_free, jnp.argmax(room))

    bearing = jnp.radians(config.max_bearing) * (2 * draws[-2] - 1)
    believed = bearing + jnp.radians(config.bearing_error) * (2 * draws[-1] - 1)
    yaw = side[chosen] + jnp.pi - bearing
    return jnp.stack([position[0][chosen], position[1][chosen], yaw]), believed


def bearing(pose: jax.Array | np.ndarray, place: jax.Array | np.ndarray) -> jax.Array:
    """Angle at which a robot sees a place.

    Args:
      pose: `[3]` x [m], y [m] and yaw [rad] of the robot.
      place: `[2]` in metres.

    Returns:
      `[]` angle from its heading, positive to the left, in radians within -pi and pi.
    """
    chex.assert_shape(pose, (3,), custom_message="pose")
    chex.assert_shape(place, (2,), custom_message="place")
    to_place = place - pose[:2]
    angle = jnp.arctan2(to_place[1], to_place[0]) - pose[2]
    return (angle + jnp.pi) % (2 * jnp.pi) - jnp.pi


def free_room(
    x: jax.Array,
    y: jax.Array,
    clearance: float,
    arena: ArenaConfig,
    layout: Layout,
    others: jax.Array,
    poi: jax.Array,
) -> jax.Array:
    """Free room around viewpoints and in the view from them.

    Args:
      x: `[C]` of the candidates, in metres.
      y: `[C]` of the candidates, in metres.
      clearance: free space that a robot needs around it, in metres.
      arena: sizes of arena and PoIs.
      layout: where the PoIs stand.
      others: `[K, 2]` positions of the other robots, in metres.
      poi: `[]` int32 index of the PoI to look at.

    Returns:
      `[C]` metres, the smallest over walls, robots and PoIs; 0 or less where a robot would be too
      close to something, or something covers part of the PoI.
    """
    chex.assert_equal_shape([x, y], custom_message="x, y")
    reach = amiro.BODY_RADIUS + clearance
    to_wall = arena.side / 2 - jnp.maximum(jnp.abs(x), jnp.abs(y)) - reach
    target = layout.position[poi]
    view_x, view_y = target[0] - x, target[1] - y
    view_length = jnp.sqrt(view_x**2 + view_y**2)

    def around(room: jax.Array, obstacle: tuple[jax.Array, jax.Array]):
        centre, radius = obstacle
        to_x, to_y = centre[0] - x, centre[1] - y
        standing = jnp.sqrt(to_x**2 + to_y**2) - radius - reach
        # The view is the cone from the sensor to the outline of the PoI.
        along = jnp.clip((to_x * view_x + to_y * view_y) / view_length, 0.0, view_length)
        share = along / view_length
        beside_x, beside_y = to_x - share * view_x, to_y - share * view_y
        across = jnp.sqrt(beside_x**2 + beside_y**2)
        in_view = across - share * arena.poi_extent - radius
        return jnp.minimum(room, jnp.minimum(standing, in_view)), None

    # The target itself is never in the way. A loop makes the compiler finish the candidates first;
    # fused with the work for each obstacle, they would be recomputed every time.
    is_target = jnp.arange(arena.num_pois) == poi
    of_pois = jnp.where(is_target, -jnp.inf, arena.poi_extent)
    of_robots = jnp.full(len(others), amiro.BODY_RADIUS, jnp.float32)
    obstacles = jnp.concatenate([layout.position, others]), jnp.append(of_pois, of_robots)
    return jax.lax.scan(around, to_wall, obstacles)[0]
