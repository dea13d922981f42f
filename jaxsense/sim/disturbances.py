"""Noise of the sensors: ranges, edges and lost beams of the LiDAR, light of the camera.

The noise of beams and pixels is new in each scan. What changes the light persists in the scene:
it depends on where and when a camera looks. Only reading noise is on by default; other disturbances
cost nothing while off.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsense.config import CameraConfig, LidarConfig
from jaxsense.core import checks
from jaxsense.core.types import Key


def measured_ranges(
    key: Key, distance: Float[Array, "B"], config: LidarConfig
) -> Float[Array, "B"]:
    """Simulates the ranges that a laser scanner measures.

    Args:
      key: random key.
      distance: true distances along neighbouring beams, in metres; infinite without a hit.
      config: settings of the scanner.

    Returns:
      Measured ranges, in metres; `max_range` without a return.
    """
    checks.require_shape("distance", distance, (None,))
    met, spread = distance, config.range_noise
    if config.mixed_pixels > 0 or config.dropout > 0:
        key, disturbance_key = jax.random.split(key)
        met = _disturbed(disturbance_key, distance, config)
    if config.range_noise_growth > 0:
        spread += config.range_noise_growth * jnp.minimum(met, config.max_range)
    noise = spread * jax.random.normal(key, met.shape)
    measured = jnp.clip(met + noise, config.min_range, config.max_range)
    return jnp.where(met <= config.max_range, measured, config.max_range)


def _disturbed(key: Key, distance: Float[Array, "B"], config: LidarConfig) -> Float[Array, "B"]:
    """Distances with mixed pixels, infinite where a beam drops out."""
    uniform = jax.random.uniform(key, (3, *distance.shape))
    # The last beam has no neighbour.
    following = jnp.append(distance[1:], distance[-1:])
    # Nothing lies between a surface and nothing. The scanner detects nothing beyond its range.
    is_edge = jnp.maximum(distance, following) <= config.max_range
    between = distance + uniform[0] * jnp.where(is_edge, following - distance, 0.0)
    met = jnp.where(uniform[1] < config.mixed_pixels, between, distance)
    return jnp.where(uniform[2] < config.dropout, jnp.inf, met)


def changes_light(config: CameraConfig) -> bool:
    """Whether exposure, colour cast, low light or shadows are switched on."""
    amounts = config.exposure_error, config.colour_cast, config.low_light, config.shadow
    return any(amount > 0 for amount in amounts)


def lighting(
    values: Float[Array, "8"], place: Float[Array, "B"], config: CameraConfig
) -> tuple[Float[Array, "3"], Float[Array, "B"]]:
    """Tells how an image is lit and exposed.

    Args:
      values: of the light's conditions where and when the camera looks.
      place: of the pixels in the whole image, from 0 at its left to 1 at its right.
      config: settings of the camera.

    Returns:
      Factors on the brightness of red, green and blue, and for each pixel 1 where the distant light
      reaches the surface, 0 in shadow.
    """
    brightness, *casts = values[:4]
    missing, falls, edge, side = jax.scipy.special.ndtr(values[4:])  # uniform from 0 to 1
    logarithm = config.exposure_error * brightness + config.colour_cast * jnp.stack(casts)
    gain = (1 - config.low_light * missing) * jnp.exp(logarithm)
    is_dark = (falls < config.shadow) & ((place >= edge) == (side < 0.5))
    return gain, jnp.where(is_dark, 0.0, 1.0)
