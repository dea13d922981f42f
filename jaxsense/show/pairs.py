"""Recorded windows, and the simulated ones that are nearest, to draw."""

import dataclasses

import numpy as np
from jaxtyping import Float

from jaxsense.sim.sensors import Sensor
from jaxsense.sim.similar import Similar


@dataclasses.dataclass(frozen=True)
class Pairs:
    """Recorded windows of one sensor, and for each the nearest simulated one.

    Attributes:
      sensor: the sensor.
      recorded: `[L, F]` inputs of its detector.
      distances: `[L]` of the PoIs, in metres.
      similar: for each the nearest simulated one, and the residuals.
    """

    sensor: Sensor
    recorded: Float[np.ndarray, "L F"]
    distances: Float[np.ndarray, " L"]
    similar: Similar
