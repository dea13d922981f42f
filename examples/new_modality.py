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


def thermal(config: Config) -> sim.Sensor:
    """The sensor: one temperature for each of 64 rays over 60 degrees."""
    angles, centre = sim.fan(num_rays=64, field_of_view=60.0)

    def read(key: jax.Array, hits: sim.Hit, surfaces: sim.Surfaces, light: sim.Light) -> jax.Array:
        temperature = sim.choose(surfaces["temperature"], hits.geom)
        temperature = jnp.where(hits.geom >= 0, temperature, ROOM)
        return temperature + NOISE * jax.random.normal(key, temperature.shape)

    def shows(readings: jax.Array, distance: jax.Array, extent: float) -> jax.Array:
        # Whether there can be a PoI at all: even a cold one is warmer than the walls.
        return readings > ROOM + 4 * NOISE

    return sim.Sensor(
        name="thermal",
        height=0.06,  # m
        angles=angles,
        centre=centre,
        window=24,
        read=read,
        shows=shows,
        blind=ROOM,
    )


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
