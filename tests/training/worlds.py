"""Worlds of other classes and sensors, and hand-made features of looks at them."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
from tiny import KEY

from jaxsense.config import (
    ArenaConfig,
    Attribute,
    Config,
    EvaluationConfig,
    JmvaeConfig,
    SensorConfig,
    Shape,
)
from jaxsense.training import fusions, jmvaes, measures
from jaxsense.training.detections import Detections
from jaxsense.training.stage import Stage, scan

SHAPES = {
    "cylinder": Shape("cylinder"),
    "cube": Shape("box"),
    "slab": Shape("box", (1.0, 0.5)),
    "post": Shape("box", (0.5, 0.5)),
}
HEAT = {"heat": Attribute({"cold": 0.0, "warm": 1.0})}
THERMAL = {"thermal": SensorConfig("custom:thermal", "heat")}
COLOURS = "red", "green", "blue", "yellow"
ACCURACY = 0.98, 0.93, 0.96
"""Of single looks by a camera, a LiDAR and a third sensor, as with noise."""


def product(*words):
    return tuple(" ".join(each) for each in itertools.product(*words))


GRID = product(COLOURS, SHAPES)
WORLDS = {
    "2x2": (product(COLOURS[:2], list(SHAPES)[:2]), 2),
    "3x2": (product(COLOURS[:3], list(SHAPES)[:2]), 2),
    "2x2x2": (product(COLOURS[:2], list(SHAPES)[:2], ("cold", "warm")), 3),
    "5": (product(COLOURS[:3], list(SHAPES)[:2])[:5], 2),
    "9": (product(COLOURS[:3], list(SHAPES)[:3]), 4),
    "11, no product": (GRID[2:13], 6),
    "16": (GRID, 6),
    "one sensor": (product(COLOURS[:3], ["cylinder"]), 2),
}
"""For each world its classes and the size of its latent space."""


def config_of(world, **jmvae):
    """Settings of a world, with those of the JMVAE."""
    classes, size = WORLDS[world]
    has_heat = world == "2x2x2"
    modalities = ("camera", "lidar", "thermal")[: 1 if world == "one sensor" else 2 + has_heat]
    settings = {
        "latent_size": size,
        "reconstruction_weights": (10.0,) * len(modalities),
        "samples_per_class": 2000,
        "fusion": "filter",
        **jmvae,
    }
    return Config(
        modalities=modalities,
        sensors=THERMAL if has_heat else {},
        arena=ArenaConfig(
            side=8.0, classes=classes, shapes=SHAPES, attributes=HEAT if has_heat else {}
        ),
        jmvae=JmvaeConfig(**settings),
        evaluation=EvaluationConfig(num_histories=8000),
    )


def features(key, label_of_class, accuracy, number):
    """`[C, S, L]` calibrated probabilities of the labels in looks of random quality.

    Logits `q e_label + sqrt(q) noise` have the softmax as their exact posterior.
    """
    labels = np.array(label_of_class)
    share = jnp.log(jnp.bincount(labels) / len(labels))[None, None]
    quality_key, noise_key = jax.random.split(key)
    quality = jax.random.normal(quality_key, (len(labels), number, 1))
    noise = jax.random.normal(noise_key, (len(labels), number, share.size))

    def of(level):
        q = jnp.exp(level + quality)
        shown = q * jnp.eye(share.size)[labels][:, None] + jnp.sqrt(q) * noise
        return jax.nn.softmax(shown + share)

    low, high = -3.0, 8.0
    for _ in range(30):
        middle = (low + high) / 2
        is_low = jnp.mean(of(middle).argmax(axis=-1) == labels[:, None]) < accuracy
        low, high = (middle, high) if is_low else (low, middle)
    return of(low)


def detections_of(config, accuracy=ACCURACY):
    """Looks to train on, and as many others to measure on."""
    number, keys = config.jmvae.samples_per_class, jax.random.split(KEY, len(config.modalities))
    found = [
        features(k, config.label_of_class(m), share, 2 * number)
        for k, m, share in zip(keys, config.modalities, accuracy, strict=False)
    ]
    nothing = ()
    return Detections(
        tuple(x[:, :number] for x in found), tuple(x[:, number:] for x in found), nothing, nothing
    )


@jax.jit
def learn(key, config, detections):
    """Outputs of all stages from the JMVAE to the beliefs."""

    def drive(stage, **inputs):
        return scan(key, config, stage, inputs)[0]

    given = {"detections": detections}
    restarts = tuple(drive(stage, **given) for stage in jmvaes.restarts(config))
    params = drive(Stage("best_jmvae", jmvaes.best), restarts=restarts, **given)
    classes = drive(Stage("class_beliefs", jmvaes.class_beliefs), params=params, **given)
    fusion = fusions.train(drive, config, params=params, classes=classes, **given)
    _, latent = drive(Stage("latent_space", measures.latent_space), fusion=fusion, **given)
    return latent, drive(Stage("beliefs", measures.beliefs), fusion=fusion, **given)
