"""Archives of every preset, and of one modality, load and give what jaxsense gives."""

import dataclasses

import jax
import numpy as np
import pytest
from exporting import with_classes

from jaxsense import export
from jaxsense.config import PRESETS
from jaxsense.interfaces import robot_numpy, robot_onnx
from jaxsense.interfaces.onboard import functions
from jaxsense.models import init
from jaxsense.tasks.pretrained import PRETRAINED, load_pretrained

SIZES = {"pois": 3, "robots": 2, "looks": 4}


def small(name):
    config = PRESETS[name]
    jmvae = dataclasses.replace(config.jmvae, hidden=(8,))
    return dataclasses.replace(
        config, jmvae=jmvae, detector=dataclasses.replace(config.detector, hidden=(8,))
    )


def of_one(modality):
    config = small("smoke")
    jmvae = dataclasses.replace(config.jmvae, reconstruction_weights=(10.0,))
    return dataclasses.replace(config, jmvae=jmvae, modalities=(modality,))


def drawn(rng, name, key, about, pois):
    shape = tuple({**SIZES, "pois": pois}.get(size, size) for size in about.shape)
    values = rng.uniform(0.1, 1.0, shape) * (0.3 if key == "bearing" else 1)
    if key == "features" or name.startswith("encode"):
        values /= values.sum(axis=-1, keepdims=True)
    if about.dtype == "int32":
        values = np.zeros(shape)
    return (values > 0.4 if about.dtype == "bool" else values).astype(about.dtype)


def untrained(config):
    models = init(jax.random.key(0), config)
    return with_classes(models, config) if config.jmvae.fusion == "in_place" else models


def check(config, models, folder):
    path, rng = folder / "archive.zip", np.random.default_rng(0)
    path.write_bytes(export.archive(config, models))
    players = [player.load(path)[1] for player in (robot_numpy, robot_onnx)]
    for name, function in functions(config).items():
        given = {
            key: drawn(rng, name, key, about, config.arena.num_pois)
            for key, about in function.inputs.items()
        }
        expected = jax.jit(function.apply)(models, *given.values())
        for programs in players:
            found = programs[name](**given)
            for key, value in expected.items():
                np.testing.assert_allclose(found[key], value, atol=2e-5, err_msg=f"{name}: {key}")


@pytest.mark.parametrize("modality", ["camera", "lidar"])
def test_an_archive_of_one_modality_gives_what_jaxsense_gives(modality, tmp_path):
    config = of_one(modality)
    check(config, untrained(config), tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted({*PRESETS} - {*PRETRAINED}))
def test_an_archive_of_a_preset_gives_what_jaxsense_gives(name, tmp_path):
    check(small(name), untrained(small(name)), tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("name", PRETRAINED)
def test_an_archive_of_a_trained_preset_gives_what_jaxsense_gives(name, tmp_path):
    check(*load_pretrained(name), tmp_path)
