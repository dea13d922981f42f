"""Archives of all presets, and of runs of one modality, load and answer as jaxsense does."""

import dataclasses
import io
import zipfile

import jax
import numpy as np
import onnx
import pytest

import jaxsense
from jaxsense import export
from jaxsense.config import PRESETS
from jaxsense.interfaces import robot
from jaxsense.interfaces.onboard import functions
from jaxsense.tasks.pretrained import PRETRAINED

SIZES = {"pois": 4, "looks": 5}
ROWS = 3


def of_one(preset, name):
    """Settings of a preset with one modality."""
    config = PRESETS[preset]
    one = dataclasses.replace(config.jmvae, reconstruction_weights=(10.0,))
    return dataclasses.replace(config, modalities=(name,), jmvae=one)


def models_of(config):
    """Models that were not trained, none of whose numbers is 0."""
    rng = np.random.default_rng(0)

    def moved(x):
        is_real = isinstance(x, jax.Array) and x.dtype == np.float32
        return x + np.float32(rng.uniform(0.05, 0.5, x.shape)) if is_real else x

    return jax.tree.map(moved, jaxsense.init(jax.random.key(0), config))


CASES = {name: PRESETS[name] for name in PRESETS} | {
    f"{preset}, {name} alone": of_one(preset, name)
    for preset in ("smoke", "noisy")
    for name in ("camera", "lidar")
}


def drawn(rng, name, key, each, sizes):
    """A plausible input of a program."""
    shape = tuple(sizes.get(n, n) for n in each.shape)
    if each.dtype == "int32":
        most = {"target": sizes["pois"] + 1, "modality": sizes["modalities"]}
        return rng.integers(0, most.get(key, sizes["robots"]), shape).astype(np.int32)
    found = rng.uniform(0.1, 1.0, shape)
    if each.dtype == "bool":
        return found > 0.3
    is_probability = key == "features" or name.startswith("encode")
    return np.float32(found / found.sum() if is_probability else found)


FAST = "default", "smoke, camera alone", "smoke, lidar alone"  # others compile for many seconds


@pytest.mark.parametrize(
    "case", [pytest.param(x, marks=[] if x in FAST else pytest.mark.slow) for x in CASES]
)
def test_an_archive_answers_as_ours_does(case):
    config = CASES[case]
    if case in PRETRAINED:
        config, models = jaxsense.load_pretrained(case)
    else:
        models = models_of(config)
    archive = export.archive(config, models)
    contents, programs = robot.load(io.BytesIO(archive))
    # Not every runtime reduces empty arrays; lists of axes, int64, may be empty.
    with zipfile.ZipFile(io.BytesIO(archive)) as files:
        graphs = [onnx.load_from_string(files.read(f"{name}.onnx")).graph for name in programs]
    constants = [each for graph in graphs for each in graph.initializer]
    assert all(0 not in x.dims for x in constants if x.data_type != onnx.TensorProto.INT64)
    ours = functions(config)
    assert {*programs} == {*ours} == {*contents["programs"]}
    rng = np.random.default_rng(0)
    robots, modalities = len(contents["robots"]), len(contents["modalities"])
    sizes = {**SIZES, "robots": robots, "modalities": modalities}
    for name, function in ours.items():
        apply = jax.jit(function.apply)
        for _ in range(ROWS):
            given = {key: drawn(rng, name, key, x, sizes) for key, x in function.inputs.items()}
            found, expected = programs[name](**given), apply(models, *given.values())
            for key, value in jax.tree.map(np.asarray, expected).items():
                assert not np.isnan(value).any()
                scale = np.abs(value[np.isfinite(value)]).max(initial=1.0)
                np.testing.assert_allclose(found[key], value, 0, 1e-4 * scale, err_msg=name)
