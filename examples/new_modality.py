"""A third robot with a thermal camera: `python examples/new_modality.py --preset smoke`."""

from dataclasses import replace

from jax import random

from jaxsense import Attribute, Config, SensorConfig, sim, train

TEMPERATURE = Attribute({"cold": 30.0, "hot": 60.0}, elsewhere=20.0)  # degrees Celsius


class Thermal(sim.Sensor):
    """A thermal camera: one temperature per ray, in degrees Celsius."""

    def read(self, key, hits, surfaces, light):
        """Measures the surfaces that the rays hit, with an error of one degree."""
        return sim.choose(surfaces["temperature"], hits.geom) + random.normal(key, hits.geom.shape)


def thermal(config: Config) -> sim.Sensor:
    """Makes the sensor: 64 rays over 60 degrees, 0.06 m above the floor."""
    return Thermal(height=0.06, rays=sim.Fan(64, 60.0), window=24, blind=TEMPERATURE.elsewhere)


def change(config: Config) -> Config:
    """Adds a word about the temperature to the classes, and a robot that measures it."""
    classes = ("green cylinder cold", "red cylinder cold", "red cube cold", "red cube hot")
    arena = replace(config.arena, attributes={"temperature": TEMPERATURE}, classes=classes)
    sensors = {"thermal": SensorConfig("new_modality:thermal", attribute="temperature")}
    modalities = (*config.modalities, "thermal")  # each on a robot of its own
    jmvae = replace(config.jmvae, reconstruction_weights=(10.0,) * 3)
    return replace(config, arena=arena, sensors=sensors, modalities=modalities, jmvae=jmvae)


if __name__ == "__main__":
    train.main(change=change)
