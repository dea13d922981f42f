"""The travel model: how long robots take to their looks.

A robot turns to a PoI, drives straight until it is near enough, and looks.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsense.core import checks
from jaxsense.core.types import pytree


@pytree
class Travel:
    """A robot that turns to a PoI, drives straight until it is near enough, and looks.

    Attributes:
      view_distance: from which it looks, in metres.
      speed: in metres per second.
      turn_rate: in radians per second.
      look_seconds: duration of a look.
    """

    view_distance: jax.Array | float
    speed: jax.Array | float = 0.2
    turn_rate: jax.Array | float = 1.2
    look_seconds: jax.Array | float = 0.7


def travel_seconds(
    travel: Travel, pose: Float[Array, "3"], places: Float[Array, "N 2"]
) -> Float[Array, " N"]:
    """Time until a robot has looked at PoIs, by the travel model.

    Args:
      travel: the travel model.
      pose: `[3]` x [m], y [m] and yaw [rad] of the robot.
      places: `[N, 2]` positions of the PoIs, in metres.

    Returns:
      `[N]` seconds.
    """
    checks.require_shape("pose", pose, (3,))
    checks.require_shape("places", places, (None, 2))
    turn, path = jax.vmap(lambda place: _path(travel, pose, place))(places)
    return travel.look_seconds + jnp.abs(turn) / travel.turn_rate + path / travel.speed


def move(
    travel: Travel,
    pose: Float[Array, "3"],
    place: Float[Array, "2"],
    seconds: Float[Array, ""],
) -> Float[Array, "3"]:
    """Pose of a robot some time after it set out for a PoI, by the travel model.

    Args:
      travel: the travel model.
      pose: `[3]` x [m], y [m] and yaw [rad] of the robot as it set out.
      place: `[2]` position of the PoI, in metres.
      seconds: `[]` since then.
    """
    turn, path = _path(travel, pose, place)
    turning = jnp.minimum(jnp.abs(turn) / travel.turn_rate, seconds)
    yaw = pose[2] + jnp.sign(turn) * turning * travel.turn_rate
    driven = jnp.minimum((seconds - turning) * travel.speed, path)
    to_place = place - pose[:2]
    along = to_place / jnp.maximum(jnp.linalg.norm(to_place), 1e-6)
    return jnp.append(pose[:2] + driven * along, yaw)


def _path(travel: Travel, pose: jax.Array, place: jax.Array) -> tuple[jax.Array, jax.Array]:
    """`[]` radians to turn and `[]` metres to drive until a robot is near enough to look."""
    to_place = place - pose[:2]
    turn = jnp.arctan2(to_place[1], to_place[0]) - pose[2]
    turn = (turn + jnp.pi) % (2 * jnp.pi) - jnp.pi
    # At zero distance the bearing is undefined: do not turn.
    distance = jnp.linalg.norm(to_place)
    turn = jnp.where(distance > 0, turn, 0.0)
    return turn, jnp.maximum(distance - travel.view_distance, 0.0)
