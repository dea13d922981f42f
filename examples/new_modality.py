"""A third robot with a sensor of your own: a thermal camera, which tells hot PoIs from cold ones.

    python examples/new_modality.py --preset smoke --out runs/thermal

takes every option of `python -m jaxsense.train`. Other programs that read the run must be able to
import this file, and be told that they may:

    PYTHONPATH=examples python -m jaxsense.evaluate runs/thermal --trust
"""

import dataclasses

import jax
import jax.numpy as jnp

from jaxsense import Attribute, Config, SensorConfig, sim, train

ROOM = 20.0  # degrees Celsius
NOISE = 1.0  # degrees Celsius


class Thermal(sim.Sensor):
    """A thermal camera: one temperature per ray."""

    def read(self, key, hits, surfaces, light):
        """Temperatures in degrees Celsius."""
        temperature = sim.choose(surfaces["temperature"], hits.geom)
        temperature = jnp.where(hits.geom >= 0, temperature, ROOM)
        return temperature + NOISE * jax.random.normal(key, temperature.shape)

    def shows(self, readings, distance, extent):
        """Which rays may have hit a PoI: even a cold one is warmer than the walls."""
        return readings > ROOM + 4 * NOISE


def thermal(config: Config) -> sim.Sensor:
    """Makes the sensor: 64 rays over 60 degrees, 0.06 m above the floor."""
    return Thermal(height=0.06, rays=sim.Fan(64, 60.0), window=24, blind=ROOM)


def change(config: Config) -> Config:
    """The settings of a preset, with temperatures and a third robot that sees them."""
    temperature = Attribute({"cold": 30.0, "hot": 60.0}, elsewhere=ROOM)
    return dataclasses.replace(
        config,
        arena=dataclasses.replace(
            config.arena,
            attributes={"temperature": temperature},
            # A class has one more word now. No sensor alone tells all of these apart.
            classes=(
                "green cylinder cold",
                "red cylinder cold",
                "red cube cold",
                "red cube hot",
            ),
        ),
        sensors={"thermal": SensorConfig("new_modality:thermal", attribute="temperature")},
        modalities=("camera", "lidar", "thermal"),
        jmvae=dataclasses.replace(config.jmvae, reconstruction_weights=(10.0, 10.0, 10.0)),
    )


if __name__ == "__main__":
    train.main(change=change)
