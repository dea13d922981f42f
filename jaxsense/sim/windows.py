"""Windows: the part of a scan around a PoI that the detector reads."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxsense.core import checks
from jaxsense.sim.sensors import Sensor


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
    start = jnp.round(sensor.centre(bearing) - span / 2).astype(jnp.int32)
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
