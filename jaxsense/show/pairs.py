"""Recorded windows, and simulated ones to draw next to them."""

import dataclasses

import numpy as np
from jaxtyping import Float

from jaxsense.sim.sensors import Sensor


@dataclasses.dataclass(frozen=True)
class Pairs:
    """Recorded windows of one sensor, and for each the nearest simulated one.

    Attributes:
      sensor: the sensor.
      recorded: `[L, F]` inputs of its detector.
      simulated: `[L, F]` the same, simulated.
      distances: `[L]` of the PoIs, in metres.
    """

    sensor: Sensor
    recorded: Float[np.ndarray, "L F"]
    simulated: Float[np.ndarray, "L F"]
    distances: Float[np.ndarray, " L"]
