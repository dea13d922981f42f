"""Looks inside and outside of what the detectors of the pretrained models have learned.

`pytest -m slow -s tests/test_known_looks.py` prints the shares.
"""

import dataclasses
import io

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsense
from jaxsense import export, recorded, sim
from jaxsense.config import ViewpointConfig
from jaxsense.interfaces import robot
from jaxsense.recorded import resampling

SCENES = 800
BEHIND, AHEAD = 0.1, 0.5  # degrees


@pytest.fixture(scope="module", params=["default", "noisy"])
def trained(request):
    config, models = jaxsense.load_pretrained(request.param)
    return request.param, config, models, sim.make_world(config)


def scans(trained, m, near, far, angles=None, seed=0):
    """Whole scans from random viewpoints, and bearing, distance and label of the PoI in each."""
    _, config, _, world = trained
    viewpoint = ViewpointConfig(min_distance=near, max_distance=far)
    world = dataclasses.replace(world, viewpoint=viewpoint)
    sensor = world.sensors[m]
    angles = sensor.angles if angles is None else angles
    directions = np.stack([np.cos(angles), np.sin(angles)]).astype(np.float32)

    @jax.jit
    def record(keys, world, classes):
        def one(args):
            scene_key, look_key, noise_key = jax.random.split(args[0], 3)
            scene = sim.random_scene(scene_key, world, args[1])
            _, scene = sim.look(look_key, world, scene, m, jnp.int32(0))  # goes there
            data = sim.place(world.arena, scene.layout, scene.poses)
            layout, light = scene.layout, scene.light
            readings = sim.scan(
                noise_key, sensor, world.arena, data, layout, light, m, directions=directions
            )
            place, pose = scene.layout.position[0], scene.poses[m]
            return readings, sim.bearing(pose, place), jnp.linalg.norm(place - pose[:2])

        return jax.lax.map(one, (keys, classes), batch_size=100)

    number = len(config.arena.classes)
    first = np.arange(SCENES) % number
    others = (first[:, None] + np.arange(config.arena.num_pois)) % number
    keys = jax.random.split(jax.random.key(seed), SCENES)
    found = map(np.asarray, record(keys, world, jnp.asarray(others)))
    return *found, np.array(config.label_of_class(config.modalities[m]))[first]


def answers(trained, m, readings, bearings, distances, sensor=None):
    """What `Models.detect` says."""
    _, _, models, world = trained
    sensor = world.sensors[m] if sensor is None else sensor
    detect = jax.jit(jax.vmap(lambda *look: models.detect(m, sensor, *look)))
    return detect(jnp.asarray(readings), jnp.asarray(bearings), jnp.asarray(distances))


def asserted(found):
    """Share of looks that are answered with a class."""
    return float(np.mean(found.is_there | (np.ptp(found.features, axis=1) > 0)))


def right(found, labels):
    """Share of the answers whose most likely label is true."""
    is_right = np.argmax(found.features, axis=1) == labels
    return float(is_right[np.asarray(found.is_there)].mean())


def report(trained, m, what, **shares):
    name = f"{trained[0]} {trained[1].modalities[m]}, {what}"
    print(f"\n{name}: " + ", ".join(f"{key} {share:.4f}" for key, share in shares.items()), end="")


@pytest.mark.slow
@pytest.mark.parametrize("m", [0, 1])
def test_looks_inside_are_known_and_looks_outside_assert_no_class(trained, m):
    view = trained[1].viewpoint
    readings, bearings, distances, labels = scans(trained, m, view.min_distance, view.max_distance)
    found = answers(trained, m, readings, bearings, distances)
    flagged, share = 1 - float(found.is_known.mean()), right(found, labels)
    report(trained, m, "inside", flagged=flagged, answered=asserted(found), right=share)
    assert flagged <= 0.005
    assert share > (0.85 if trained[0] == "noisy" else 0.98)

    # Whole turns do not matter.
    for turns in (-1, 1):
        turned = answers(trained, m, readings, bearings + turns * 2 * np.pi, distances)
        same = np.abs(turned.features - found.features).max(axis=1) < 1e-4
        report(
            trained, m, f"{turns} turn", the_same=same.mean(), flagged=1 - turned.is_known.mean()
        )
        assert turned.is_known.all()
        # A bearing just between two windows may take the other one.
        assert same.mean() > 0.99

    for distance in (view.min_distance - 0.1, view.max_distance + 0.1):
        beyond = scans(trained, m, distance - 0.001, distance + 0.001, seed=1)[:3]
        found = answers(trained, m, *beyond)
        report(trained, m, f"at {distance:.2f} m", answered=asserted(found))
        assert asserted(found) == 0
        assert not found.is_known.any()


@pytest.mark.slow
@pytest.mark.parametrize("m", [0, 1])
def test_a_sensor_of_half_the_spacing_is_not_the_one_that_was_learned(trained, m):
    _, config, _, _ = trained
    view = config.viewpoint
    fine = dataclasses.replace(
        config,
        lidar=dataclasses.replace(config.lidar, num_beams=2 * config.lidar.num_beams - 1),
        camera=dataclasses.replace(config.camera, num_pixels=2 * config.camera.num_pixels),
    )
    sensor = sim.sensors.make(fine)[m]
    looks = scans(trained, m, view.min_distance, view.max_distance, sensor.angles, seed=2)
    readings, bearings, distances, labels = looks
    found = answers(trained, m, readings, bearings, distances, sensor)
    report(trained, m, "half the spacing", answered=asserted(found))
    assert not found.is_known.any()
    assert asserted(found) == 0
    # Along the rays that were learned, it is.
    own = trained[3].sensors[m]
    along = recorded.resample(own, sensor.angles, readings)
    found = answers(trained, m, along, bearings, distances)
    report(trained, m, "resampled", flagged=1 - found.is_known.mean(), right=right(found, labels))
    assert found.is_known.mean() >= 0.995


@pytest.mark.slow
@pytest.mark.parametrize("m", [0, 1])
def test_archives_know_the_same_looks(trained, m):
    _, config, models, _ = trained
    view, name = config.viewpoint, config.modalities[m]
    contents, programs = robot.load(io.BytesIO(export.archive(config, models)))
    expected = [view.min_distance, view.max_distance]
    np.testing.assert_allclose(contents["learned"][name]["distance"], expected, rtol=1e-6)
    for distance, is_known in zip((0.2, 0.5, view.max_distance + 0.1), (0, 1, 0), strict=True):
        looks = scans(trained, m, distance - 0.001, distance + 0.001, seed=4)
        for readings, bearing, at, _ in list(zip(*looks, strict=True))[:40]:
            for turns in (-1, 0, 1):
                given = {"readings": readings, "bearing": bearing + turns * 2 * np.pi}
                found = programs[f"detect_{name}"](**given, distance=at)
                assert found["is_known"] == is_known
                assert is_known or not (found["is_there"] or np.ptp(found["features"]))


def uneven():
    behind = np.arange(90.0, 270.0, BEHIND)
    return np.radians(np.concatenate([behind, np.arange(-90.0, 90.0, AHEAD)]))


@pytest.mark.slow
def test_uneven_and_merged_beams_are_read_as_even_ones(trained):
    m = trained[1].modalities.index("lidar")
    own, view = trained[3].sensors[m], trained[1].viewpoint
    limits = view.min_distance, view.max_distance
    sweeps = np.concatenate([own.angles.astype(np.float64) + i * 1e-7 for i in range(3)])
    for name, angles in (("uneven", uneven()), ("merged", sweeps)):
        parts = np.split(angles, 3) if name == "merged" else [angles]
        # The same scenes, viewpoints and noise.
        each = [scans(trained, m, *limits, part, seed=3) for part in parts]
        readings = np.concatenate([readings for readings, *_ in each], axis=1)
        closed = [resampling.close_gaps(angles, scan, step=own.steps[1]) for scan in readings]
        along = recorded.resample(own, angles, np.stack(closed))
        _, bearings, distances, labels = each[0]
        found = answers(trained, m, along, bearings, distances)
        flagged = 1 - float(found.is_known.mean())
        report(
            trained,
            m,
            name,
            nan=np.isnan(along).mean(),
            flagged=flagged,
            answered=asserted(found),
            right=right(found, labels),
        )
        assert flagged <= 0.005
        assert right(found, labels) > (0.85 if trained[0] == "noisy" else 0.97)
