"""Exported detectors and encoders of scans, against those of jaxsense."""

import dataclasses
import io

import jax
import jax.numpy as jnp
import numpy as np
from exporting import CONFIG, played
from smoke import save_models

from jaxsense import export
from jaxsense.config import PRESETS, LocalisationConfig, SearchConfig
from jaxsense.core.types import Belief
from jaxsense.interfaces import robot
from jaxsense.interfaces.onboard import functions
from jaxsense.models import init, make_readout
from jaxsense.run.rundir import RunDirectory, Settings
from jaxsense.sim import sensors
from jaxsense.sim import windows as windowing

BATCH = 12


def test_an_exported_detector_answers_what_is_not_there(file, tmp_path):
    given, expected = {}, {}
    for sensor in sensors.make(CONFIG):
        name = f"detect_{sensor.name}"
        scan = np.full(functions(CONFIG)[name].inputs["readings"].shape, 0.5, np.float32)
        ahead = len(scan) // 2
        at = {"bearing": 0.0, "distance": 1.0}
        cases = [
            (scan, at, True),
            (np.where(scan > 0, np.nan, scan), at, False),
            (scan.copy(), at, False),
            (-scan, at, False),
            # A beam without a return; no pixel is infinitely bright.
            (np.where(scan > 0, np.inf, scan), at, sensor.measures_distance),
            (np.zeros_like(scan), at, True),
            *((scan, {**at, "bearing": b}, False) for b in (np.radians(121.0), -np.pi, np.nan)),
            *((scan, {**at, "distance": d}, False) for d in (0.0, -1.0, np.inf, np.nan)),
        ]
        cases[2][0][ahead : ahead + 4] = np.nan  # the camera reads every fourth pixel
        given[f"{name}/readings"] = np.stack([readings for readings, _, _ in cases])
        given |= {f"{name}/{key}": np.float32([x[key] for _, x, _ in cases]) for key in at}
        expected[name] = np.array([is_there for _, _, is_there in cases])
    found = played(file, given, tmp_path)
    for name, is_there in expected.items():
        np.testing.assert_array_equal(found[f"{name}/is_there"], is_there)
        features = found[f"{name}/features"]
        assert np.isfinite(features).all()
        np.testing.assert_allclose(features[~is_there], 0.5)


def test_encoders_of_scans_give_what_jaxsense_gives(tmp_path):
    networks = dataclasses.replace(PRESETS["raw"].jmvae, hidden=(8, 8))
    config = dataclasses.replace(CONFIG, jmvae=networks)
    learned = init(jax.random.key(0), config)
    means = jnp.array([[0.5, 0.5], [-0.5, 0.5], [0.5, -0.5]])
    classes = Belief(means, jnp.full((3, 2), 0.9))
    readout = make_readout(config, classes)
    encoders = tuple(dataclasses.replace(x, readout=readout) for x in learned.detectors)
    learned = dataclasses.replace(learned, detectors=encoders)
    with RunDirectory.create(tmp_path / "run", Settings("smoke", 0, config)) as created:
        save_models(created, learned)
    path = tmp_path / "exported.zip"
    export.main([str(tmp_path / "run"), "--out", str(path)])
    rng, given, expected = np.random.default_rng(0), {}, {}
    for sensor, encoder in zip(sensors.make(config), encoders, strict=True):
        name = f"detect_{sensor.name}"
        shape = functions(config)[name].inputs["readings"].shape
        scans = rng.uniform(0.3, 0.9, (BATCH, *shape)).astype(np.float32)
        bearings = rng.uniform(-0.3, 0.3, BATCH).astype(np.float32)
        given |= {
            f"{name}/readings": scans,
            f"{name}/bearing": bearings,
            f"{name}/distance": np.full(BATCH, 0.6, np.float32),
        }

        def features(scan, bearing):
            return encoder.features(windowing.cut_out(sensor, scan, bearing))  # noqa: B023

        expected[name] = np.asarray(jax.jit(jax.vmap(features))(scans, bearings))
        assert np.ptp(expected[name], axis=0).max() > 1e-3
    found = played(path, given, tmp_path)
    for name, each in expected.items():
        np.testing.assert_allclose(found[f"{name}/features"], each, atol=1e-5)


def test_an_exported_robot_searches_as_missions_do(models):
    errors = SearchConfig(position=0.06, heading=3.0)
    localisation = LocalisationConfig(search=errors)
    config = dataclasses.replace(
        CONFIG, mission=dataclasses.replace(CONFIG.mission, localisation=localisation)
    )
    # Untrained detectors have no scale, and are never unsure.
    unsure = tuple(
        dataclasses.replace(
            each,
            scale=jnp.float32(1.0),
            gate=dataclasses.replace(each.gate, scale=jnp.float32(1.0)),
        )
        for each in models.detectors
    )
    models = dataclasses.replace(models, detectors=unsure)
    _, programs = robot.load(io.BytesIO(export.archive(config, models)))
    rng = np.random.default_rng(0)
    for m, sensor in enumerate(sensors.make(config)):

        @jax.jit
        def detect(*given):
            return [models.detect(m, sensor, *given, *search) for search in ((errors,), ())]  # noqa: B023

        channels = () if sensor.channels == 1 else (sensor.channels,)
        for bearing, distance in ((0.1, 0.7), (-0.2, 0.4), (3.0, 0.5)):
            scan = rng.uniform(0.1, 1.0, (len(sensor.angles), *channels)).astype(np.float32)
            given = scan, np.float32(bearing), np.float32(distance)
            searched, plain = detect(*given)
            about = dict(zip(("readings", "bearing", "distance"), given, strict=True))
            found = programs[f"detect_{sensor.name}"](**about)
            assert found["is_there"] == searched.is_there == (bearing < 1)
            np.testing.assert_allclose(found["features"], searched.features, atol=1e-5)
            assert bearing > 1 or np.abs(searched.features - plain.features).max() > 1e-4
