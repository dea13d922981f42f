"""Recorded windows, and the simulated ones that are nearest, to draw."""

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
      simulated: `[L, F]` the nearest simulated ones.
      residuals: `[L, F]` recorded minus simulated, NaN on rays that hit no PoI.
      usual: `[L, F]` the same of other simulated windows in place of the recorded ones.
      distances: `[L]` of the PoIs, in metres.
    """

    sensor: Sensor
    recorded: Float[np.ndarray, "L F"]
    simulated: Float[np.ndarray, "L F"]
    residuals: Float[np.ndarray, "L F"]
    usual: Float[np.ndarray, "L F"]
    distances: Float[np.ndarray, " L"]
