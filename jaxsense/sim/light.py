"""The light of a scene, what changes it over positions and time, and what images make of it.

Only reading noise is on by default; other disturbances cost nothing while off.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsense.config import CameraConfig
from jaxsense.core import checks
from jaxsense.core.types import Key, pytree

_NUM_WAVES = 32
_NUM_CONDITIONS = 8  # numbers that `lighting` takes


@pytree
class Conditions:
    """What changes the light of a scene: eight independent values at each position and time.

    Each is a Gaussian random field by random Fourier features (Rahimi & Recht 2007): over scenes,
    its value at any point is standard normal, and `exp(-d^2 / 2)` is the correlation of its values
    at two points at a distance d.

    Attributes:
      frequencies: `[K, 3]` of K plane waves, in radians.
      weights: `[8, 2 K]` of their cosines and sines.
    """

    frequencies: jax.Array
    weights: jax.Array

    def at(self, point: Float[Array, "3"]) -> Float[Array, "8"]:
        """Values at a point: x, y and time, each in units over which the values change."""
        # Without matrix products, which accelerators round.
        phase = jnp.sum(self.frequencies * point[None], axis=-1)
        waves = jnp.concatenate([jnp.cos(phase), jnp.sin(phase)])
        return jnp.sum(self.weights * waves[None], axis=-1) / len(phase) ** 0.5


@pytree
class Light:
    """A distant light source and ambient light.

    Attributes:
      direction: `[3]` unit vector towards the light.
      diffuse: strength of the distant light.
      ambient: strength of the ambient light.
      conditions: exposure, colour and shadow, which drift; None if no sensor reads them.
      point: `[3]` where and when a sensor looks: x [m], y [m] and time [s]; None until
        `sensors.scan` sets it.
    """

    direction: jax.Array
    diffuse: jax.Array
    ambient: jax.Array
    conditions: Conditions | None = None
    point: jax.Array | None = None

    def changes(self, distance: float = 0.5, time: float = 60.0) -> Float[Array, "8"]:
        """Values of the conditions where and when a sensor looks, standard normal over scenes.

        Args:
          distance: over which they change, in metres.
          time: over which they change, in seconds.

        Raises:
          ValueError: if the conditions have not been drawn, or the point has not been set.
        """
        if self.conditions is None:
            raise ValueError(
                "light.conditions = None: must be drawn, as by random_light(key, "
                "world.reads_conditions), because the settings of a sensor change the light"
            )
        if self.point is None:
            raise ValueError("light.point = None: must be set, as sim.scan does")
        return self.conditions.at(self.point / jnp.array([distance, distance, time]))


def random_conditions(key: Key) -> Conditions:
    """Draws the conditions of a scene."""
    frequency_key, weight_key = jax.random.split(key)
    return Conditions(
        frequencies=jax.random.normal(frequency_key, (_NUM_WAVES, 3)),
        weights=jax.random.normal(weight_key, (_NUM_CONDITIONS, 2 * _NUM_WAVES)),
    )


def random_light(key: Key, has_conditions: bool = False) -> Light:
    """Draws a light of random strength from any side, 20 to 70 degrees above the floor.

    Args:
      has_conditions: whether to draw what changes the light, see `World.reads_conditions`.
    """
    checks.require_key(key)
    light_key, condition_key = jax.random.split(key)
    side, height, diffuse, ambient = jax.random.uniform(light_key, (4,))
    side, height = 2 * jnp.pi * side, jnp.radians(20.0 + 50.0 * height)
    flat = jnp.cos(height)
    direction = jnp.stack([flat * jnp.cos(side), flat * jnp.sin(side), jnp.sin(height)])
    conditions = random_conditions(condition_key) if has_conditions else None
    return Light(direction, 0.2 + 0.6 * diffuse, 0.3 + 0.3 * ambient, conditions)


def lighting(
    values: Float[Array, "8"], place: Float[Array, "B"], config: CameraConfig
) -> tuple[Float[Array, "3"], Float[Array, "B"]]:
    """How an image is lit and exposed.

    Args:
      values: of the light's conditions where and when the camera looks.
      place: of the pixels in the whole image, from 0 at its left to 1 at its right.

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
