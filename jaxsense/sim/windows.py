"""Windows: the part of a scan around a PoI, which the detector reads."""

import chex
import jax
import jax.numpy as jnp
import numpy as np

from jaxsense.config import ArenaConfig
from jaxsense.core import checks
from jaxsense.sim.sensors import Sensor

_SHARE_OF_WIDTH = 0.7  # of a PoI, that a ray must meet


def window_of(sensor: Sensor, values: np.ndarray, bearing: jax.Array) -> jax.Array:
    """Values of those rays of a scan that the detector reads.

    Args:
      sensor: the sensor.
      values: `[..., B]` of all rays, for example `sensor.angles`.
      bearing: `[]` at the centre of these rays, in radians in the robot's frame; near the edge of
        the field of view they stop at its last ray.

    Returns:
      `[..., window]` values.
    """
    chex.assert_rank(bearing, 0, custom_message="bearing")
    *shape, number = values.shape
    start = _first_ray(sensor, bearing)
    # One slice of all rays a stride apart: XLA would recompute a list of indices for each ray, from
    # the bearing on.
    padded = np.pad(values, [(0, 0)] * len(shape) + [(0, -number % sensor.stride)])
    strided = jnp.array(padded.reshape(*shape, -1, sensor.stride))
    zero = jnp.int32(0)  # of the same type as the other indices also with 64 bits
    place = [zero] * len(shape) + [start // sensor.stride, start % sensor.stride]
    return jax.lax.dynamic_slice(strided, place, (*shape, sensor.window, 1))[..., 0]


def _first_ray(sensor: Sensor, bearing: jax.Array) -> jax.Array:
    """Index of the first ray that the detector reads around a bearing, `[]` int32."""
    span = (sensor.window - 1) * sensor.stride
    start = jnp.round(sensor.centre(bearing) - span / 2).astype(jnp.int32)
    return jnp.clip(start, 0, len(sensor.angles) - 1 - span)


def cut_out(sensor: Sensor, readings: jax.Array | np.ndarray, bearing: jax.Array | float):
    """Cuts the detector's input out of a whole scan, recorded or simulated.

    Args:
      sensor: the sensor.
      readings: `[B, ...]` of all its rays in their order: a LiDAR's in metres from right to left, a
        camera's as linear RGB in [0, 1] from left to right.
      bearing: `[]` of the PoI in the robot's frame, in radians, positive to the left.

    Returns:
      `[F]` input of `vae.detect`.
    """
    channels = () if sensor.channels == 1 else (sensor.channels,)
    shape = (len(sensor.angles), *channels)
    chex.assert_shape(readings, shape, custom_message=f"readings of {sensor.name}")
    is_turn = "must be within -pi and pi: it is in radians"
    checks.require("bearing", bearing, lambda x: np.abs(x) <= np.pi, is_turn)
    dtype = jnp.result_type(readings)
    if jnp.issubdtype(dtype, jnp.integer):
        reason = "must be real numbers, in metres or from 0 to 1"
        raise ValueError(f"readings of dtype {dtype}: {reason}")
    at_least = "must be a number that is not negative"
    checks.require(f"readings of {sensor.name}", readings, lambda x: x >= 0, at_least)
    bearing = jnp.asarray(bearing, jnp.float32)
    rays = _first_ray(sensor, bearing) + sensor.stride * jnp.arange(sensor.window)
    return as_window(sensor, jnp.asarray(readings, jnp.float32)[rays])


def shows_poi(
    sensor: Sensor,
    readings: jax.Array,
    bearing: jax.Array,
    distance: jax.Array,
    arena: ArenaConfig,
    bearing_error: jax.Array | float = 0.0,
) -> jax.Array:
    """Whether readings may show a PoI where it is expected.

    The LiDAR judges by distance. The camera distinguishes a PoI from walls, robots and darkness by
    its colour, but not from another PoI before or behind it: good viewpoints have none there.

    Args:
      sensor: the sensor.
      readings: `[window, ...]` of the rays around the bearing.
      bearing: `[]` at which the PoI is expected, in radians in the robot's frame.
      distance: `[]` at which its centre is expected, in metres.
      arena: sizes of PoIs.
      bearing_error: `[]` largest error of the bearing, in radians.

    Returns:
      `[]` bool: a ray that may meet a PoI of this size can have met one, and so can all that must,
      except for twice the share that the sensor loses on average. False for a covered or absent
      PoI, or a failed sensor; of a camera whose light changes, for a failed one only.
    """
    angles = jnp.abs(window_of(sensor, sensor.angles, bearing) - bearing)
    half_width = jnp.arcsin(jnp.minimum(arena.poi_half_width / distance, 1.0))
    shows = sensor.shows(readings, distance, arena.poi_extent)
    must = angles <= jnp.minimum(_SHARE_OF_WIDTH * half_width, half_width - bearing_error)
    may = angles <= half_width + bearing_error
    return jnp.any(may & shows) & (jnp.sum(must & ~shows) <= 2 * sensor.lost * jnp.sum(must))


def as_window(sensor: Sensor, readings: jax.Array) -> jax.Array:
    """Input of the detector, `[F]`, from the `[window, ...]` readings of its rays."""
    chex.assert_axis_dimension(readings, 0, sensor.window, custom_message="readings")
    return jnp.minimum(readings, sensor.window_limit).reshape(-1)
