"""Exported programs, against functions of jaxsense and rules by hand."""

import dataclasses
import io
import json
import zipfile

import jax
import jax.numpy as jnp
import numpy as np
import onnx
import pytest
from exporting import CONFIG, drawn
from untrained import untrained

import jaxsense
from jaxsense import export
from jaxsense.config import PRESETS
from jaxsense.core.types import Belief
from jaxsense.interfaces import robot
from jaxsense.models import make_travel
from jaxsense.run.version import __version__
from jaxsense.sim import sensors
from jaxsense.tasks.registry import PRETRAINED
from jaxsense.vae import detectors, readout

BATCH = 12
TRAVEL = make_travel(CONFIG)
SIZES = {"pois": 3, "robots": 2, "looks": 4}


@pytest.fixture(scope="module")
def loaded(file):
    return robot.load(file)


def check(loaded, name, expected, *keys):
    """`expected(*inputs of one example) -> outputs`; returns outputs of all examples."""
    contents, programs = loaded
    rng, rows = np.random.default_rng(0), []
    for _ in range(BATCH):
        given = drawn(rng, contents, name, SIZES)
        rows.append(programs[name](**given))
        assert {*rows[-1]} == {*contents["programs"][name]["outputs"]}
        for key, value in zip(keys, expected(*given.values()), strict=True):
            np.testing.assert_allclose(rows[-1][key], value, atol=1e-5, err_msg=f"{name}/{key}")
    return rows


@pytest.mark.parametrize("m", [0, 1])
def test_programs_of_a_sensor_give_what_jaxsense_gives(models, loaded, m):
    name, sensor = CONFIG.modalities[m], sensors.make(CONFIG)[m]
    of_window = jax.jit(lambda *look: detectors.features(models.detectors[m], *look))

    def detect(readings, bearing, distance):
        # The nearest window in the scan, ray by ray.
        first = round(float(sensor.rays.centre(bearing)) - (sensor.window - 1) * sensor.stride / 2)
        rays = first + np.arange(sensor.window) * sensor.stride
        window = np.minimum(readings[rays], sensor.window_limit).reshape(-1)
        features = np.asarray(of_window(window, distance))
        return True, True, features.max() >= CONFIG.mission.least_confidence, features

    @jax.jit
    def write(mean, std, seen, features, weight):
        after = models.fusion.update(Belief(mean, std), seen, features, m, weight)
        return after.mean, after.std

    @jax.jit
    def weigh(apart):
        return models.novelty.weight(apart, m), models.novelty.to_go(apart, m)

    check(loaded, f"detect_{name}", detect, "is_known", "is_there", "detects", "features")
    check(loaded, f"weigh_{name}", weigh, "weight", "to_go")
    check(loaded, f"write_{name}", write, "new_mean", "new_std")


@pytest.mark.parametrize("m", [0, 1])
def test_a_detector_answers_what_is_not_there(loaded, m):
    sensor, (_, programs) = sensors.make(CONFIG)[m], loaded
    scan = np.full(sensor.shape, 0.5, np.float32)
    torn = scan.copy()
    torn[len(scan) // 2 :][:4] = np.nan  # the camera reads every fourth pixel
    cases = [
        (scan, 0.0, 1.0, True),
        (np.full_like(scan, np.nan), 0.0, 1.0, False),
        (torn, 0.0, 1.0, False),
        (-scan, 0.0, 1.0, False),
        # A beam without a return; no pixel is infinitely bright.
        (np.full_like(scan, np.inf), 0.0, 1.0, sensor.measures_distance),
        (np.zeros_like(scan), 0.0, 1.0, True),
        *((scan, bearing, 1.0, False) for bearing in (np.radians(121.0), -np.pi, np.nan)),
        *((scan, 0.0, distance, False) for distance in (0.0, -1.0, np.inf, np.nan)),
    ]
    for readings, bearing, distance, is_there in cases:
        program = programs[f"detect_{sensor.name}"]
        found = program(readings=readings, bearing=bearing, distance=distance)
        assert found["is_there"] == is_there
        assert np.isfinite(found["features"]).all()
        if not is_there:
            np.testing.assert_allclose(found["features"], 0.5)


def test_the_map_is_read_as_jaxsense_reads_it(models, loaded):
    means = models.fusion.classes.mean

    @jax.jit
    @jax.vmap
    def classify(mean, std):
        belief, fusion = Belief(mean, std), models.fusion
        plausible = readout.plausible_classes(belief, means)
        probabilities = fusion.class_probabilities(belief)
        return probabilities, jnp.argmax(probabilities), plausible

    check(loaded, "classify", classify, "probabilities", "most_likely", "plausible")


def test_contents_describe_what_is_there(models, file, loaded):
    contents, programs = loaded
    with zipfile.ZipFile(file) as files:
        graphs = {x: onnx.load_model_from_string(files.read(f"{x}.onnx")).graph for x in programs}
        # Data alone.
        assert {f"{name}.onnx" for name in programs} | {"contents.json"} == {*files.namelist()}
    for name, about in contents["programs"].items():
        for ends, key in ((graphs[name].input, "inputs"), (graphs[name].output, "outputs")):
            shapes = {
                each.name: [n.dim_param or n.dim_value for n in each.type.tensor_type.shape.dim]
                for each in ends
            }
            assert shapes == {n: x["shape"] for n, x in about[key].items()}
            assert all(x["about"] for x in about[key].values())
    # Three PoIs, two latent dimensions.
    weights = {each.name: tuple(each.dims) for each in graphs["decide"].initializer}
    assert weights["q_networks/0/params/Dense_0/kernel"][0] == 12
    assert contents["labels"] == {"camera": ["red", "green"], "lidar": ["cylinder", "cube"]}
    assert contents["classes"] == list(CONFIG.arena.classes)
    for sensor in sensors.make(CONFIG):
        angles = contents["sensors"][sensor.name]["angles"]
        np.testing.assert_allclose(angles, sensor.angles, atol=1e-6)
        assert contents["sensors"][sensor.name]["height"] == sensor.height
    limits = contents["viewpoint"]
    assert (limits["min_distance"], limits["max_distance"]) == (0.3, 1.2)
    assert limits["max_bearing"] == pytest.approx(np.radians(20), abs=1e-6)
    assert contents["versions"] == {"jaxsense": __version__}
    unseen = export._description(CONFIG, untrained(CONFIG))["unseen"]
    assert unseen == {"mean": [0.0, 0.0], "std": pytest.approx([20.0**0.5] * 2)}
    json.dumps(unseen)


def of_one(preset, name):
    """Settings of a preset with one modality."""
    config = PRESETS[preset]
    one = dataclasses.replace(config.jmvae, reconstruction_weights=(10.0,))
    return dataclasses.replace(config, modalities=(name,), jmvae=one)


CASES = {name: PRESETS[name] for name in PRESETS} | {
    f"noisy, {name} alone": of_one("noisy", name) for name in ("camera", "lidar")
}


def models_of(config):
    """Models that were not trained, none of whose numbers is 0."""
    rng = np.random.default_rng(0)

    def moved(x):
        is_real = isinstance(x, jax.Array) and x.dtype == np.float32
        return x + np.float32(rng.uniform(0.05, 0.5, x.shape)) if is_real else x

    return jax.tree.map(moved, untrained(config))


def constants_of(graph):
    """Weights and constants, also of loops."""
    yield from graph.initializer
    for attribute in (each for node in graph.node for each in node.attribute):
        yield from [attribute.t] if attribute.HasField("t") else constants_of(attribute.g)


@pytest.mark.slow  # compiles every program of each
@pytest.mark.parametrize("case", CASES)
def test_an_archive_answers_as_ours_does(case):
    config = CASES[case]
    known = jaxsense.load_pretrained(case) if case in PRETRAINED else (config, models_of(config))
    config, models = known
    archive = export.archive(config, models)
    contents, programs = robot.load(io.BytesIO(archive))
    # Not every runtime reduces empty arrays; lists of axes, int64, may be empty.
    with zipfile.ZipFile(io.BytesIO(archive)) as files:
        graphs = [onnx.load_from_string(files.read(f"{name}.onnx")).graph for name in programs]
    constants = [each for graph in graphs for each in constants_of(graph)]
    assert all(0 not in x.dims for x in constants if x.data_type != onnx.TensorProto.INT64)
    ours, rng = export.functions(config), np.random.default_rng(0)
    assert {*programs} == {*ours} == {*contents["programs"]}
    sizes = {"pois": 4, "looks": 5, "robots": len(contents["robots"])}
    for name, (function, _) in ours.items():
        apply = jax.jit(function)
        for _ in range(3):
            given = drawn(rng, contents, name, sizes)
            found, expected = programs[name](**given), apply(models, *given.values())
            for key, value in jax.tree.map(np.asarray, expected).items():
                assert not np.isnan(value).any()
                scale = np.abs(value[np.isfinite(value)]).max(initial=1.0)
                np.testing.assert_allclose(found[key], value, 0, 1e-4 * scale, err_msg=name)
