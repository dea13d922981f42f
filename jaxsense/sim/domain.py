"""The domain of a detector: the looks that it has learned from.

Elsewhere it may be certain and wrong.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxsense.config import Config
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
      bearing: `[2]` of the PoI in the robot's frame, in radians: that of viewpoints, and beyond it
        as far as the window's rays lie around the PoI as they do there.
      step: `[2]` angle between neighbouring rays that the detector reads, in radians.
      range: `[2]` `window_limit` of the sensor, twice.
    """

    distance: Float[Array, "2"]
    bearing: Float[Array, "2"]
    step: Float[Array, "2"]
    range: Float[Array, "2"]

    def contains(
        self, sensor: Sensor, bearing: Float[Array, ""], distance: Float[Array, ""]
    ) -> Bool[Array, ""]:
        """Tells whether a look is one of those that the detector has learned from.

        Args:
          sensor: the sensor that looks.
          bearing: of the PoI in the robot's frame, in radians; any turns.
          distance: expected distance of the PoI's centre, in metres.
        """
        pairs = (
            (distance, self.distance),
            (windows.wrapped(bearing), self.bearing),
            (jnp.asarray(sensor.steps), self.step),
            (sensor.window_limit, self.range),
        )
        inside = [
            jnp.all((x >= low - _ROUNDING) & (x <= high + _ROUNDING)) for x, (low, high) in pairs
        ]
        return jnp.stack(inside).all()


def make_domain(config: Config, sensor: Sensor) -> Domain:
    """Makes the domain of the detector that a training with these settings gives a sensor.

    Args:
      config: all settings.
      sensor: one of `sensors.make(config)`.
    """
    view, errors = config.viewpoint, config.mission.localisation
    deviations = _DEVIATIONS * errors.in_training
    either = jnp.array([-1.0, 1.0])
    distances = jnp.stack([jnp.asarray(view.min_distance), jnp.asarray(view.max_distance)])
    off = view.max_bearing + view.bearing_error + deviations * errors.heading_error
    return Domain(
        distance=distances + deviations * errors.position_error * either,
        bearing=_bearings(sensor, jnp.radians(off) * either),
        step=jnp.asarray(sensor.steps),
        range=jnp.full(2, sensor.window_limit),
    )


def _bearings(sensor: Sensor, drawn: Float[Array, "2"]) -> Float[Array, "2"]:
    """Bearings in view at which a window's rays lie around the PoI as they do at drawn ones."""
    angles, span = sensor.angles, (sensor.window - 1) * sensor.stride
    starts = np.round(np.arange(len(angles)) - span / 2).astype(int)
    starts = np.clip(starts, 0, len(angles) - 1 - span)
    ends = angles[starts[:, None] + np.array([0, span])] - angles[:, None]
    is_drawn = (angles >= drawn[0]) & (angles <= drawn[1])
    low, high = (
        reduce(ends, axis=0, where=is_drawn[:, None], initial=start)
        for reduce, start in ((jnp.min, jnp.inf), (jnp.max, -jnp.inf))
    )
    is_known = ((ends >= low - _ROUNDING) & (ends <= high + _ROUNDING)).all(axis=1)
    least = jnp.min(angles, where=is_known, initial=drawn[0])
    most = jnp.max(angles, where=is_known, initial=drawn[1])
    return jnp.clip(jnp.stack([least, most]), angles.min(), angles.max())
