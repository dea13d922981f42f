"""Search: the windows of a scan in which a robot that may be misplaced looks for a PoI."""

import dataclasses
import math

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsense.config.mission import Search
from jaxsense.core.types import pytree
from jaxsense.sim import windows
from jaxsense.sim.sensors import Sensor

_NEAREST = 0.3  # m, expected distance below which a search gets no wider
_STEP = 0.03  # m, between expected distances
_DEVIATIONS = 3.0  # standard deviations that the largest errors are


@pytree
class Candidates:
    """Windows that may show a PoI, and distances at which it may be.

    Attributes:
      windows: `[K, F]` inputs of the detector, in the order of the rays.
      distances: `[J]` of the PoI's centre, in metres.
      log_prior: `[J, K]` logarithm of how likely an error is that explains them, up to a constant;
        minus infinity beyond the largest errors.
    """

    windows: Float[Array, "K F"]
    distances: Float[Array, " J"]
    log_prior: Float[Array, "J K"]


def widened(sensor: Sensor, search: Search) -> Sensor:
    """The sensor with a window that contains those of a search; without one, the sensor itself.

    It reaches no farther than the scan, and as far as errors explain at 0.3 m or farther away.
    """
    if not search.applies or len(sensor.angles) < 2:
        return sensor
    between = sensor.field_of_view * sensor.stride / (len(sensor.angles) - 1)
    off = math.hypot(search.heading, math.degrees(search.position / _NEAREST))
    most = (len(sensor.angles) - 1) // sensor.stride + 1
    window = min(sensor.window + 2 * math.ceil(off / between), most)
    return dataclasses.replace(sensor, window=window)


def candidates(
    sensor: Sensor,
    search: Search,
    window: Float[Array, " F"],
    bearing: Float[Array, ""],
    distance: Float[Array, ""],
) -> Candidates:
    """Windows one ray of the detector apart, and distances at most 3 cm apart.

    Errors are independent and normal; the largest ones are three standard deviations.

    Args:
      window: `[F]` readings of the rays that `widened` reads around the bearing, see `as_window`.
      bearing: at which the robot expects the PoI, in its frame, in radians.
      distance: at which it expects the PoI's centre, in metres.
    """
    wide = widened(sensor, search)
    number, steps = wide.window - sensor.window + 1, math.ceil(search.position / _STEP)
    angles = windows.around(wide, sensor.angles, bearing)
    low, high = (sensor.window - 1) // 2, sensor.window // 2
    middles = (angles[low : low + number] + angles[high : high + number]) / 2
    off = jnp.abs(middles - bearing)
    largest = jnp.hypot(jnp.radians(search.heading), search.position / distance)
    # Keeps the window nearest to the bearing even if no ray lies within the error.
    is_near = (off <= largest) | (off == jnp.min(off))
    of_bearings = jnp.where(is_near, -((_DEVIATIONS * off / largest) ** 2) / 2, -jnp.inf)
    shares = np.linspace(-1.0, 1.0, 2 * steps + 1)
    of_distances = jnp.asarray(-((_DEVIATIONS * shares) ** 2) / 2)
    rays = window.reshape(wide.window, -1)
    of_windows = np.arange(number)[:, None] + np.arange(sensor.window)
    return Candidates(
        windows=rays[of_windows].reshape(number, -1),
        distances=distance + search.position * shares,
        log_prior=of_distances[:, None] + of_bearings[None],
    )
