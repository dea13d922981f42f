"""Windows: the part of a scan around a PoI that the detector reads."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Shaped

from jaxsense.core import checks
from jaxsense.sim.sensors import Sensor


def window_of(
    sensor: Sensor, values: Shaped[np.ndarray, "*axes B"], bearing: Float[Array, ""]
) -> Shaped[Array, "*axes window"]:
    """Selects the values of the window's rays from those of all rays.

    Args:
      sensor: the sensor.
      values: one value per ray, for example `sensor.angles`.
      bearing: bearing of the window's centre in the robot's frame, in radians. Near the edge of the
        field of view, the window ends at the last ray.

    Returns:
      The values of the window's rays.
    """
    checks.require_shape("bearing", bearing, ())
    *shape, num_rays = values.shape
    start = _first_ray(sensor, bearing)
    # One slice of all rays a stride apart: XLA would recompute an array of indices, starting from
    # the bearing, for each ray.
    padded = np.pad(values, [(0, 0)] * len(shape) + [(0, -num_rays % sensor.stride)])
    strided = jnp.array(padded.reshape(*shape, -1, sensor.stride))
    first = [0] * len(shape) + [start // sensor.stride, start % sensor.stride]
    return jax.lax.dynamic_slice(strided, first, (*shape, sensor.window, 1))[..., 0]


def rays_of(sensor: Sensor, bearing: Float[Array, ""]) -> Float[Array, "2 _"]:
    """Selects the directions of the rays that the readings of a window need.

    Args:
      sensor: the sensor.
      bearing: see `window_of`.

    Returns:
      Directions of the window's rays; if the sensor reads neighbours, of all rays from the window's
      first to the one after its last.
    """
    if not sensor.reads_neighbours:
        return window_of(sensor, sensor.directions, bearing)
    # The last ray of all has no neighbour but itself.
    padded = jnp.array(np.pad(sensor.directions, [(0, 0), (0, 1)], mode="edge"))
    number = (sensor.window - 1) * sensor.stride + 2
    return jax.lax.dynamic_slice_in_dim(padded, _first_ray(sensor, bearing), number, axis=1)


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
      sensor: the sensor.
      readings: readings of all rays, in their order: a LiDAR's in metres from right to left, a
        camera's as linear RGB in [0, 1] from left to right.
      bearing: bearing of the PoI in the robot's frame, in radians, positive to the left.

    Returns:
      The input of `vae.detect`. `Models.detect` also tells whether it shows a PoI.

    Raises:
      ValueError: if a reading is negative, not a number or not real, or the bearing is not within
        -pi and pi.
    """
    checks.require_shape(f"readings of {sensor.name}", readings, sensor.shape)
    is_turn = "must be from -pi to pi: it is in radians"
    checks.require("bearing", bearing, lambda x: np.abs(x) <= np.pi, is_turn)
    dtype = jnp.result_type(readings)
    if jnp.issubdtype(dtype, jnp.integer):
        reason = "must be real numbers, in metres or from 0 to 1"
        raise ValueError(f"readings of dtype {dtype}: {reason}")
    at_least = "must be at least 0; NaN was not recorded: leave the look out"
    checks.require(f"readings of {sensor.name}", readings, lambda x: x >= 0, at_least)
    return as_window(sensor, around(sensor, readings, jnp.asarray(bearing)))


def around(
    sensor: Sensor, readings: Float[Array | np.ndarray, "B *channels"], bearing: Float[Array, ""]
) -> Float[Array, "window *channels"]:
    """Selects the readings of the window's rays, without checks.

    Args:
      sensor: the sensor.
      readings: readings of all rays.
      bearing: bearing of the window's centre in the robot's frame, in radians; may be traced.
    """
    start = _first_ray(sensor, jnp.asarray(bearing, jnp.float32))
    rays = start + sensor.stride * jnp.arange(sensor.window)
    return jnp.asarray(readings, jnp.float32)[rays]


def wrapped(bearing: Float[Array, ""]) -> Float[Array, ""]:
    """The bearing without whole turns, from -pi to pi; one that is there stays as it is.

    Args:
      bearing: in radians.
    """
    return bearing - 2 * jnp.pi * jnp.round(bearing / (2 * jnp.pi))


def as_window(sensor: Sensor, readings: Float[Array, "window *channels"]) -> Float[Array, "F"]:
    """Converts the readings of a window into the detector's input.

    Args:
      sensor: the sensor.
      readings: readings of the rays that the detector reads.

    Returns:
      The readings as one vector, limited to `sensor.window_limit`. A distance of 0 counts as no
      return, that is as infinite: drivers of laser scanners write it for one.
    """
    checks.require_shape("readings", readings, (sensor.window, ...))
    if sensor.measures_distance:
        readings = jnp.where(readings == 0, jnp.inf, readings)
    return jnp.minimum(readings, sensor.window_limit).reshape(-1)
