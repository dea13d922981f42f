"""Looks that do not show their PoI: empty places, walls, covers, other robots, wrong bearings."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsense.config.scene import ArenaConfig, ViewpointConfig
from jaxsense.core.types import Index, Key, pytree
from jaxsense.sim import amiro
from jaxsense.sim.sensors import Sensor

_SHARES = {"empty": 2, "wall": 3, "outside": 1, "off": 2, "covered": 2, "robot": 3}
_MIN_DISTANCE = 0.12  # m, between the centres of two robots


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
    limits = np.cumsum(list(_SHARES.values())) / sum(_SHARES.values())
    drawn = jnp.searchsorted(jnp.array(limits, jnp.float32), situation, side="right")
    kind = {name: drawn == i for i, name in enumerate(_SHARES)}
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
    half_width = jnp.array([_half_width(sensor) for sensor in sensors])[robot]
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


def _half_width(sensor: Sensor) -> float:
    """Half the width, at the sensor's height, of a robot that carries the same sensor."""
    return amiro.LIDAR_HALF_WIDTH if sensor.is_on_top else amiro.BODY_RADIUS
