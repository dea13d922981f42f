"""A third robot with a sensor of your own: a thermal camera, which tells hot PoIs from cold ones.

    python examples/new_modality.py --preset smoke --out runs/thermal

takes every option of `python -m jaxsense.train`. To load the run, other programs must be able to
import this file and be allowed to:

    PYTHONPATH=examples python -m jaxsense.evaluate runs/thermal --trust
"""

from dataclasses import replace

import jax
import jax.numpy as jnp

from jaxsense import Attribute, Config, SensorConfig, sim, train

ROOM, NOISE = 20.0, 1.0  # degrees Celsius


class Thermal(sim.Sensor):
    """A thermal camera: one temperature per ray, in degrees Celsius."""

    def read(self, key, hits, surfaces, light):
        """Measures the surfaces that the rays hit, or the room."""
        temperature = sim.choose(surfaces["temperature"], hits.geom)
        temperature = jnp.where(hits.geom >= 0, temperature, ROOM)
        return temperature + NOISE * jax.random.normal(key, temperature.shape)

    def shows(self, readings, distance, extent):
        """Tells which rays may have hit a PoI: even a cold one is warmer than the walls."""
        return readings > ROOM + 4 * NOISE


def thermal(config: Config) -> sim.Sensor:
    """Makes the sensor: 64 rays over 60 degrees, 0.06 m above the floor."""
    return Thermal(height=0.06, rays=sim.Fan(64, 60.0), window=24, blind=ROOM)


def change(config: Config) -> Config:
    """Adds temperatures, and a third robot that measures them, to the settings of a preset."""
    temperature = Attribute({"cold": 30.0, "hot": 60.0}, elsewhere=ROOM)
    # A class now has a third word. No sensor can tell all of these classes apart.
    classes = ("green cylinder cold", "red cylinder cold", "red cube cold", "red cube hot")
    return replace(
        config,
        arena=replace(config.arena, attributes={"temperature": temperature}, classes=classes),
        sensors={"thermal": SensorConfig("new_modality:thermal", attribute="temperature")},
        modalities=("camera", "lidar", "thermal"),
        jmvae=replace(config.jmvae, reconstruction_weights=(10.0, 10.0, 10.0)),
    )


if __name__ == "__main__":
    train.main(change=change)
