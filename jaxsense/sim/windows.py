"""Windows: the part of a scan around a PoI that the detector reads.

A robot that may be misplaced tries several of them. The domain of a detector are the looks that it
has learned from; elsewhere it may be certain and wrong.
"""

import dataclasses
import math

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxsense.config import Config
from jaxsense.config.mission import Search
from jaxsense.config.scene import MAX_BEARING
from jaxsense.core import checks
from jaxsense.core.types import pytree
from jaxsense.sim.sensors import Sensor

_NEAREST = 0.3  # m, expected distance below which a search gets no wider
_STEP = 0.03  # m, between expected distances of a search
_DEVIATIONS = 3.0  # standard deviations that the largest errors are
_ROUNDING = 1e-5


def rays_of(sensor: Sensor, bearing: Float[Array, ""]) -> Float[Array, "2 _"]:
    """Directions of the rays of a window around a bearing in the robot's frame, in radians.

    Near the edge of the field of view, the window ends at the last ray. If the sensor reads
    neighbours, they are those of all rays from the window's first to the one after its last.
    """
    chex.assert_rank(bearing, 0)
    start, stride, directions = _first_ray(sensor, bearing), sensor.stride, sensor.directions
    if sensor.reads_neighbours:
        # The last ray of all has no neighbour but itself.
        padded = jnp.array(np.pad(directions, [(0, 0), (0, 1)], mode="edge"))
        number = (sensor.window - 1) * stride + 2
        return jax.lax.dynamic_slice_in_dim(padded, start, number, axis=1)
    # One slice of all rays a stride apart: XLA would recompute an array of indices, starting from
    # the bearing, for each ray.
    padded = np.pad(directions, [(0, 0), (0, -len(sensor.angles) % stride)])
    strided = jnp.array(padded.reshape(2, -1, stride))
    first = (0, start // stride, start % stride)
    return jax.lax.dynamic_slice(strided, first, (2, sensor.window, 1))[..., 0]


def _first_ray(sensor: Sensor, bearing: Float[Array, ""]) -> Int[Array, ""]:
    """Index of the first ray that the detector reads around a bearing."""
    span = (sensor.window - 1) * sensor.stride
    start = jnp.round(sensor.rays.centre(bearing) - span / 2).astype(jnp.int32)
    return jnp.clip(start, 0, len(sensor.angles) - 1 - span)


@checks.typed
def cut_out(
    sensor: Sensor,
    readings: Float[Array | np.ndarray, "B *channels"],
    bearing: Float[Array | np.ndarray, ""] | float,
) -> Float[Array, "F"]:
    """Cuts the detector's input, a window, out of a whole scan, recorded or simulated.

    Args:
      readings: of all rays: a LiDAR's in metres from right to left, a camera's as linear RGB in
        [0, 1] from left to right.
      bearing: of the PoI in the robot's frame, in radians, positive to the left.

    Raises:
      ValueError: if a reading is negative, not a number or not real, or the bearing is not within
        -pi and pi.
    """
    checks.require_shape(f"readings of {sensor.name}", readings, sensor.shape)
    is_turn = "must be from -pi to pi: it is in radians"
    checks.require("bearing", bearing, lambda x: np.abs(x) <= np.pi, is_turn)
    if readings.dtype.kind in "iu":
        reason = "must be real numbers, in metres or from 0 to 1"
        raise ValueError(f"readings of dtype {readings.dtype}: {reason}")
    at_least = "must be at least 0; NaN was not recorded: leave the look out"
    checks.require(f"readings of {sensor.name}", readings, lambda x: x >= 0, at_least)
    return as_window(sensor, around(sensor, readings, jnp.asarray(bearing)))


def around(
    sensor: Sensor, readings: Float[Array | np.ndarray, "B *channels"], bearing: Float[Array, ""]
) -> Float[Array, "window *channels"]:
    """Readings of the window's rays, from those of all rays; nothing is checked."""
    start = _first_ray(sensor, jnp.asarray(bearing, jnp.float32))
    rays = start + sensor.stride * jnp.arange(sensor.window)
    return jnp.asarray(readings, jnp.float32)[rays]


def wrapped(bearing: Float[Array, ""]) -> Float[Array, ""]:
    """The bearing without whole turns, from -pi to pi; one that is there stays as it is."""
    return bearing - 2 * jnp.pi * jnp.round(bearing / (2 * jnp.pi))


def as_window(sensor: Sensor, readings: Float[Array, "window *channels"]) -> Float[Array, "F"]:
    """The detector's input: readings as one vector, limited to `sensor.window_limit`.

    A distance of 0 counts as no return, that is as infinite: drivers of laser scanners write it for
    one.
    """
    chex.assert_axis_dimension(readings, 0, sensor.window)
    if sensor.measures_distance:
        readings = jnp.where(readings == 0, jnp.inf, readings)
    return jnp.minimum(readings, sensor.window_limit).reshape(-1)


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
) -> tuple[Float[Array, "K F"], Float[Array, " J"], Float[Array, "J K"]]:
    """Windows one ray of the detector apart that may show a PoI, and distances at which it may be.

    Errors are independent and normal; the largest ones are three standard deviations.

    Args:
      window: readings of the rays that `widened` reads around the bearing, see `as_window`.
      bearing: at which the robot expects the PoI, in its frame, in radians.
      distance: at which it expects the PoI's centre, in metres.

    Returns:
      Inputs of the detector, in the order of the rays; distances at most 3 cm apart; and the
      logarithm of how likely an error is that explains them, up to a constant, minus infinity
      beyond the largest errors.
    """
    wide = widened(sensor, search)
    number, steps = wide.window - sensor.window + 1, math.ceil(search.position / _STEP)
    angles = around(wide, sensor.angles, bearing)
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
    tried = rays[of_windows].reshape(number, -1)
    log_prior = of_distances[:, None] + of_bearings[None]
    return tried, distance + search.position * shares, log_prior


@pytree
class Domain:
    """Limits, lowest and highest, of the looks that a detector has learned from.

    Attributes:
      distance: `[2]` expected distance from the sensor to the PoI's centre, in metres.
      bearing: `[2]` of the PoI in the robot's frame, in radians: those of viewpoints, and others at
        which the window's rays lie alike around the PoI.
      step: `[2]` angle between neighbouring rays that the detector reads, in radians.
      range: `[2]` `window_limit` of the sensor, twice; the largest number for none.
    """

    distance: Float[Array, "2"]
    bearing: Float[Array, "2"]
    step: Float[Array, "2"]
    range: Float[Array, "2"]

    def contains(
        self, sensor: Sensor, bearing: Float[Array, ""], distance: Float[Array, ""]
    ) -> Bool[Array, ""]:
        """Whether the detector has learned looks from this bearing [rad] and distance [m]."""
        least, most = sensor.steps
        limit = jnp.nan_to_num(sensor.window_limit)
        look = jnp.stack([distance, wrapped(bearing), least, most, limit])
        limits = jnp.stack([self.distance, self.bearing, self.step, self.step, self.range])
        is_within = (look >= limits[:, 0] - _ROUNDING) & (look <= limits[:, 1] + _ROUNDING)
        return jnp.all(is_within)


def make_domain(config: Config, sensor: Sensor) -> Domain:
    """Domain of the detector that a training with these settings gives a sensor."""
    view, errors = config.viewpoint, config.mission.localisation
    deviations = _DEVIATIONS * errors.in_training
    off = MAX_BEARING + view.bearing_error + deviations * errors.error[1]
    drawn, either = jnp.radians(off), jnp.array([-1.0, 1.0])
    angles, number = sensor.angles, len(sensor.angles)
    # Evenly spaced rays lie alike around PoIs at all bearings, unless the window meets an end.
    is_even = np.ptp(sensor.steps) < _ROUNDING
    margin = (sensor.window - 1) * sensor.stride // 2 + 1 if is_even else number
    inner = angles[margin : number - margin]
    bearings = [jnp.min(inner, initial=-drawn), jnp.max(inner, initial=drawn)]
    distances = [jnp.asarray(view.min_distance), jnp.asarray(view.max_distance)]
    return Domain(
        distance=jnp.stack(distances) + deviations * errors.error[0] * either,
        bearing=jnp.clip(jnp.stack(bearings), angles.min(), angles.max()),
        step=jnp.array(sensor.steps),
        range=jnp.full(2, jnp.nan_to_num(sensor.window_limit)),
    )
