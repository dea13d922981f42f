"""What makes sensors unsure, beside the noise of single readings: light, edges, lost beams.

All of it is off by default. A disturbance that is off is no part of the program: it takes no time,
and changes no bit of a reading.
"""

import chex
import jax
import jax.numpy as jnp

from jaxsense.config import CameraConfig, LidarConfig
from jaxsense.core.types import Key


def measured_ranges(key: Key, distance: jax.Array, config: LidarConfig) -> jax.Array:
    """What a laser scanner measures.

    Args:
      key: random key.
      distance: `[B]` true distances of neighbouring beams, in metres; infinite without a hit.
      config: `range_noise` and `range_noise_growth`, `mixed_pixels`, `dropout`, and the range.

    Returns:
      `[B]` measured distances, in metres; `max_range` without a return.
    """
    chex.assert_rank(distance, 1, custom_message="distance")
    is_disturbed = config.mixed_pixels > 0 or config.dropout > 0
    met = _disturbed(key, distance, config) if is_disturbed else distance
    spread = config.range_noise
    if config.range_noise_growth > 0:
        spread += config.range_noise_growth * jnp.minimum(met, config.max_range)
    noise = spread * jax.random.normal(key, met.shape, jnp.float32)
    measured = jnp.clip(met + noise, config.min_range, config.max_range)
    return jnp.where(met <= config.max_range, measured, config.max_range)


def _disturbed(key: Key, distance: jax.Array, config: LidarConfig) -> jax.Array:
    """`[B]` distances with mixed pixels and without the beams that drop out."""
    # The key itself draws the noise, as it does without disturbances.
    uniform = jax.random.uniform(jax.random.fold_in(key, 1), (3, *distance.shape), jnp.float32)
    # The last beam has no next one. Beyond its range, the scanner meets nothing.
    within = jnp.minimum(distance, config.max_range)
    following = jnp.append(within[1:], within[-1:])
    between = within + uniform[0] * (following - within)
    met = jnp.where(uniform[1] < config.mixed_pixels, between, distance)
    return jnp.where(uniform[2] < config.dropout, jnp.inf, met)


def changes_light(config: CameraConfig) -> bool:
    """Whether any disturbance of the camera is on."""
    amounts = config.exposure_error, config.colour_cast, config.low_light, config.shadow
    return any(amount > 0 for amount in amounts)


def lighting(key: Key, num_pixels: int, config: CameraConfig) -> tuple[jax.Array, jax.Array]:
    """How an image is lit and exposed.

    Args:
      key: random key.
      num_pixels: B.
      config: `exposure_error`, `colour_cast`, `low_light` and `shadow`.

    Returns:
      `[3]` factors on the brightness of red, green and blue, and `[B]` which pixels the distant
      light reaches, 0 or 1.
    """
    # The key itself draws the noise, as it does without disturbances.
    normal_key, uniform_key = jax.random.split(jax.random.fold_in(key, 1))
    brightness, *casts = jax.random.normal(normal_key, (4,), jnp.float32)
    missing, falls, edge, side = jax.random.uniform(uniform_key, (4,), jnp.float32)
    logarithm = config.exposure_error * brightness + config.colour_cast * jnp.stack(casts)
    gain = (1 - config.low_light * missing) * jnp.exp(logarithm)
    is_beyond = jnp.arange(num_pixels) >= edge * num_pixels
    is_dark = (falls < config.shadow) & (is_beyond == (side < 0.5))
    return gain, jnp.where(is_dark, 0.0, 1.0)
