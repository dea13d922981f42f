"""Poses from which a sensor faces a PoI, in range and free of collisions."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxsense.config.scene import CLEARANCE, MAX_BEARING, ArenaConfig, ViewpointConfig
from jaxsense.core.types import Index, Key
from jaxsense.sim import amiro
from jaxsense.sim.arena import Layout

NUM_CANDIDATES = 16


def random_viewpoint(
    key: Key,
    config: ViewpointConfig,
    arena: ArenaConfig,
    layout: Layout,
    others: Float[Array, "K 2"],
    poi: Int[Array, ""],
) -> tuple[Float[Array, "3"], Float[Array, ""]]:
    """Pose from which a robot looks at a PoI, and the bearing of the PoI as it believes it.

    Candidates are uniform in distance and direction. Returns the first one that is free and has an
    unobstructed view of the PoI, or the one with the most room if there is none.

    Args:
      others: positions of the other robots, in metres.
    """
    chex.assert_shape(others, (None, 2))
    # A single draw, because each use of the random generator takes long to compile.
    draws = jax.random.uniform(key, (2 * NUM_CANDIDATES + 2,))
    near, far = config.min_distance, config.max_distance
    distance = near + (far - near) * draws[:NUM_CANDIDATES]
    side = jnp.pi * (2 * draws[NUM_CANDIDATES:-2] - 1)
    target = layout.position[poi]
    position = target[0] + distance * jnp.cos(side), target[1] + distance * jnp.sin(side)
    room = free_room(position[0], position[1], CLEARANCE, arena, layout, others, poi)
    first_free = jnp.argmax(room > 0)
    chosen = jnp.where(jnp.any(room > 0), first_free, jnp.argmax(room))

    bearing, believed = _bearings(draws[-2], draws[-1], config)
    yaw = side[chosen] + jnp.pi - bearing
    return jnp.stack([position[0][chosen], position[1][chosen], yaw]), believed


def moved_viewpoint(
    key: Key,
    config: ViewpointConfig,
    arena: ArenaConfig,
    layout: Layout,
    others: Float[Array, "K 2"],
    poi: Int[Array, ""],
    position: Float[Array, "2"],
    distance: Float[Array, ""],
) -> tuple[Float[Array, "3"], Float[Array, ""]]:
    """`random_viewpoint` at a distance from a place, in metres.

    The pose is at the place itself if no free one at that distance is in range and shows the PoI.
    """
    draws = jax.random.uniform(key, (NUM_CANDIDATES + 2,))
    direction, target = jnp.pi * (2 * draws[:-2] - 1), layout.position[poi]
    x = position[0] + distance * jnp.cos(direction)
    y = position[1] + distance * jnp.sin(direction)
    to_poi = jnp.sqrt((x - target[0]) ** 2 + (y - target[1]) ** 2)
    is_free = free_room(x, y, CLEARANCE, arena, layout, others, poi) > 0
    is_free &= (to_poi >= config.min_distance) & (to_poi <= config.max_distance)
    chosen = jnp.argmax(is_free)
    stand = jnp.where(jnp.any(is_free), jnp.stack([x[chosen], y[chosen]]), position)
    bearing, believed = _bearings(draws[-2], draws[-1], config)
    yaw = jnp.arctan2(target[1] - stand[1], target[0] - stand[0]) - bearing
    return jnp.append(stand, yaw), believed


def _bearings(
    heading: jax.Array, error: jax.Array, config: ViewpointConfig
) -> tuple[jax.Array, jax.Array]:
    """Bearing of a PoI, and the one that the robot believes, from uniform draws."""
    bearing = jnp.radians(MAX_BEARING) * (2 * heading - 1)
    return bearing, bearing + jnp.radians(config.bearing_error) * (2 * error - 1)


def bearing(
    pose: Float[Array | np.ndarray, "3"], position: Float[Array | np.ndarray, "2"]
) -> Float[Array, ""]:
    """Bearing of a position in a robot's frame, positive to the left, within -pi and pi."""
    chex.assert_shape(pose, (3,))
    offset = position - pose[:2]
    angle = jnp.arctan2(offset[1], offset[0]) - pose[2]
    return (angle + jnp.pi) % (2 * jnp.pi) - jnp.pi


def free_room(
    x: Float[Array, "V"],
    y: Float[Array, "V"],
    clearance: Float[Array, ""] | float,
    arena: ArenaConfig,
    layout: Layout,
    others: Float[Array, "K 2"],
    poi: Index,
) -> Float[Array, "V"]:
    """Smallest margin to walls, robots and PoIs of V viewpoints, in metres.

    It is 0 or less where a robot would be too close to something, or something hides part of the
    PoI.

    Args:
      x: of the viewpoints, in metres.
      y: of the viewpoints, in metres.
      clearance: free space that a robot needs around it, in metres.
      others: positions of the other robots, in metres.
    """
    reach = amiro.BODY_RADIUS + clearance
    to_wall = arena.side / 2 - jnp.maximum(jnp.abs(x), jnp.abs(y)) - reach
    target = layout.position[poi]
    view_x, view_y = target[0] - x, target[1] - y
    view_length = jnp.sqrt(view_x**2 + view_y**2)

    def around(room: jax.Array, obstacle: tuple[jax.Array, jax.Array]):
        centre, radius = obstacle
        to_x, to_y = centre[0] - x, centre[1] - y
        standing = jnp.sqrt(to_x**2 + to_y**2) - radius - reach
        # The view is a cone from the sensor to the PoI's outline.
        along = jnp.clip((to_x * view_x + to_y * view_y) / view_length, 0.0, view_length)
        share = along / view_length
        beside_x, beside_y = to_x - share * view_x, to_y - share * view_y
        across = jnp.sqrt(beside_x**2 + beside_y**2)
        in_view = across - share * arena.poi_extent - radius
        return jnp.minimum(room, jnp.minimum(standing, in_view)), None

    # The target never obstructs the view. The loop makes the compiler finish the viewpoints first;
    # fused into the loop's body, they would be recomputed for each obstacle.
    is_target = jnp.arange(arena.num_pois) == poi
    of_pois = jnp.where(is_target, -jnp.inf, arena.poi_extent)
    of_robots = jnp.full(len(others), amiro.BODY_RADIUS)
    obstacles = jnp.concatenate([layout.position, others]), jnp.append(of_pois, of_robots)
    return jax.lax.scan(around, to_wall, obstacles, unroll=4)[0]
