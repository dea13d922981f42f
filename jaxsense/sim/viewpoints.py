"""Room at viewpoints, and looks that do not show their PoI.

These show empty places, walls, covers or other robots, or are in a wrong direction.
"""

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsense.config.scene import ArenaConfig, ViewpointConfig
from jaxsense.core.types import Index, Key, pytree, within_a_turn
from jaxsense.sim import amiro
from jaxsense.sim.arena import Layout, room_beside
from jaxsense.sim.sensors import Sensor

_ABSENT = {"empty": 2, "wall": 3, "outside": 1, "off": 2, "covered": 2, "robot": 3}  # shares
_MIN_DISTANCE = 0.12  # m, between the centres of two robots
_VIEW_SAMPLES = 33  # of a view; closer to each other than walls are thick up to 1.6 m


def bearing(
    pose: Float[Array | np.ndarray, "3"], position: Float[Array | np.ndarray, "2"]
) -> Float[Array, ""]:
    """Bearing of a position in a robot's frame, positive to the left, within -pi and pi."""
    chex.assert_shape(pose, (3,))
    offset = position - pose[:2]
    return within_a_turn(jnp.arctan2(offset[1], offset[0]) - pose[2])


def free_room(
    x: Float[Array, "V"],
    y: Float[Array, "V"],
    clearance: Float[np.ndarray, "V"] | float,
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
    if len(layout.walls):
        to_wall = jnp.minimum(to_wall, room_beside(layout.walls, x, y) - reach)
        shares = jnp.linspace(0.0, 1.0, _VIEW_SAMPLES)[:, None]
        beside = room_beside(
            layout.walls, x[None] + shares * view_x[None], y[None] + shares * view_y[None]
        )
        to_wall = jnp.minimum(to_wall, jnp.min(beside - shares * arena.poi_extent, axis=0))

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


@pytree
class View:
    """What one look depends on: where everything stands, and where the robot expects the PoI.

    Attributes:
      positions: centres of the PoIs, in metres.
      poses: x [m], y [m] and yaw [rad] of each robot.
      twin: one more robot that carries the same sensor; outside the walls if there is none.
      bearing: believed bearing of the PoI in the robot's frame, in radians.
      distance: expected distance of the PoI's centre, in metres.
    """

    positions: Float[Array, "N 2"]
    poses: Float[Array, "R 3"]
    twin: Float[Array, "2"]
    bearing: Float[Array, ""]
    distance: Float[Array, ""]


def outside(arena: ArenaConfig) -> Float[np.ndarray, "2"]:
    """A position outside the walls, which no ray from inside reaches, in metres."""
    return np.array([-10 * arena.side, 0.0], np.float32)


def without_poi(
    key: Key,
    sensors: tuple[Sensor, ...],
    arena: ArenaConfig,
    viewpoint: ViewpointConfig,
    view: View,
    robot: Index,
    poi: Index,
) -> View:
    """Changes a look so that it does not show its PoI.

    Draws one of these situations: an empty place; a wall at any distance; nothing at all, as
    outside the arena; a wrong bearing; or a robot before the PoI or in its place. `view` is a look
    at the PoI from a free viewpoint.
    """
    draws = jax.random.uniform(key, (10,))
    situation, x, y, yaw, depth, off, stay, near_by, beside, alone = draws
    limits = np.cumsum(list(_ABSENT.values())) / sum(_ABSENT.values())
    drawn = jnp.searchsorted(jnp.array(limits, jnp.float32), situation, side="right")
    kind = {name: drawn == i for i, name in enumerate(_ABSENT)}
    away, pose = jnp.array(outside(arena)), view.poses[robot]

    # Where the robot stands, and where it expects a PoI.
    play = arena.side / 2 - amiro.BODY_RADIUS
    turn = jnp.pi * (2 * yaw - 1)
    anywhere = jnp.stack([play * (2 * x - 1), play * (2 * y - 1), turn])
    beyond = jnp.stack([-away[0], away[1], turn / 3])  # looks away from the arena
    pose = jnp.where(kind["wall"], anywhere, jnp.where(kind["outside"], beyond, pose))
    near, far = viewpoint.min_distance, viewpoint.max_distance
    any_distance = near + (far - near) * depth
    is_there = kind["off"] | kind["covered"]
    distance = jnp.where(is_there, view.distance, any_distance)
    wrong = _wrong_bearing(off, sensors, arena, view, robot)
    bearing = jnp.where(kind["off"], wrong, view.bearing)

    # The PoIs, and the twin.
    direction = pose[2] + view.bearing
    ahead = jnp.stack([jnp.cos(direction), jnp.sin(direction)])
    left = jnp.stack([-ahead[1], ahead[0]])
    keeps_others = (stay < 0.5) & ~(kind["wall"] | kind["off"])
    positions = jnp.where(keeps_others, view.positions, away[None])
    positions = positions.at[poi].set(jnp.where(is_there, view.positions[poi], away))
    # At the sensor's height, of a robot that carries the same one.
    widths = [amiro.LIDAR_HALF_WIDTH if s.is_on_top else amiro.BODY_RADIUS for s in sensors]
    half_width = jnp.array(widths)[robot]
    least = jnp.maximum(_MIN_DISTANCE / distance, 0.15)
    share = jnp.where(kind["covered"], least + (0.7 - least) * near_by, least + near_by)
    aside = 0.7 * half_width * (2 * beside - 1)
    twin = pose[:2] + share * distance * ahead + aside * left
    has_twin = kind["covered"] | kind["robot"] | ((alone < 0.25) & kind["wall"])
    return View(
        positions=positions,
        poses=view.poses.at[robot].set(pose),
        twin=jnp.where(has_twin, twin, away),
        bearing=bearing,
        distance=distance,
    )


def _wrong_bearing(
    draw: Float[Array, ""],
    sensors: tuple[Sensor, ...],
    arena: ArenaConfig,
    view: View,
    robot: Index,
) -> Float[Array, ""]:
    """A bearing in the field of view, at which the PoI does not cover the window's centre."""
    ends = jnp.array([[s.angles.min(), s.angles.max()] for s in sensors])[robot]
    apart = jnp.arcsin(jnp.minimum(arena.poi_extent / view.distance, 1.0)) + jnp.radians(3.0)
    right = jnp.maximum(view.bearing - apart - ends[0], 0.0)
    left = jnp.maximum(ends[1] - view.bearing - apart, 0.0)
    offset = draw * (right + left)
    return jnp.where(offset < right, ends[0] + offset, ends[1] - (offset - right))
