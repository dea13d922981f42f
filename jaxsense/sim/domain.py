"""The domain of a detector: the looks that it has learned from.

Elsewhere it may be certain and wrong.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxsense.config import Config
from jaxsense.config.scene import MAX_BEARING
from jaxsense.core.types import pytree
from jaxsense.sim import windows
from jaxsense.sim.sensors import Sensor

_ROUNDING = 1e-5
_DEVIATIONS = 3.0  # of a robot's pose in training


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
        look = jnp.stack([distance, windows.wrapped(bearing), least, most, limit])
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
