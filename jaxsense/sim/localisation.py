"""Errors of localisation: what robots believe about their own poses, less the truth.

The error of a robot's pose has a part that stays as it is throughout a mission, such as that of
its first fix, and one that grows while the robot drives, like that of odometry: a random walk whose
variance is proportional to the distance.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsense.config.mission import LocalisationConfig
from jaxsense.core.types import Key


def draw(key: Key, config: LocalisationConfig, num_robots: int) -> Float[Array, "R 3"]:
    """Error of each robot's pose at the start of a mission: believed minus true [m, m, rad]."""
    scale = _scale(*config.error)
    return scale * jax.random.normal(key, (num_robots, 3))


def drift(
    key: Key,
    config: LocalisationConfig,
    error: Float[Array, "R 3"],
    driven: Float[Array, " R"],
) -> Float[Array, "R 3"]:
    """Errors after the robots have driven on for `driven` metres."""
    scale = _scale(*config.drift)
    return error + scale * jnp.sqrt(driven)[:, None] * jax.random.normal(key, error.shape)


def variance(
    config: LocalisationConfig, driven: Float[Array, ""], distance: Float[Array, "*B"]
) -> Float[Array, "*B"]:
    """Variance between the places that two robots on one side of a thing note, in square metres.

    Args:
      driven: metres that each of them has driven at most.
      distance: of the thing, in metres.
    """
    of_error, of_drift = _scale(*config.error)[0], _scale(*config.drift)[0]
    position, _, heading = of_error**2 + driven * of_drift**2
    return 2 * (position + heading * distance**2)


def aimed_at(
    position: Float[Array, "2"], pose: Float[Array, "3"], error: Float[Array, "3"]
) -> Float[Array, "2"]:
    """Where a robot really heads when it drives to a position, in metres.

    It takes the course that would lead there from the pose that it believes it has. Without an
    error that is the position itself, to the last bit.
    """
    to_x, to_y = position - (pose + error)[:2]
    cos, sin = jnp.cos(error[2]) - 1, jnp.sin(error[2])
    turned = jnp.stack([cos * to_x + sin * to_y, cos * to_y - sin * to_x])
    return position - error[:2] + turned


def _scale(position: float, heading: float) -> Float[Array, "1 3"]:
    """Standard deviations of x [m], y [m] and yaw [rad], from metres and degrees."""
    return jnp.stack([position, position, jnp.radians(heading)])[None]
