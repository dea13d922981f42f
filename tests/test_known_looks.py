"""Looks inside and outside of what the detectors of the pretrained models have learned."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsense
from jaxsense import sim
from jaxsense.config.scene import ViewpointConfig
from jaxsense.sim.viewpoints import bearing

SCENES = 800


@pytest.fixture(scope="module", params=["default", "noisy"])
def trained(request):
    config, models = jaxsense.load_pretrained(request.param)
    return request.param, config, models, sim.make_world(config)


def scans(trained, m, near, far, seed=0):
    """Whole scans from random viewpoints, and bearing, distance and label of the PoI in each."""
    _, config, _, world = trained
    viewpoint = ViewpointConfig(min_distance=near, max_distance=far)
    world = dataclasses.replace(world, viewpoint=viewpoint)
    sensor = world.sensors[m]

    @jax.jit
    def record(keys, world, classes):
        def one(args):
            scene_key, look_key, noise_key = jax.random.split(args[0], 3)
            scene = sim.random_scene(scene_key, world, args[1])
            _, scene = sim.look(look_key, world, scene, m, jnp.int32(0))  # goes there
            data = sim.place(world.arena, scene.layout, scene.poses)
            layout, light = scene.layout, scene.light
            rays = sensor.directions
            readings = sim.scan(noise_key, sensor, world.arena, data, layout, light, m, rays)
            place, pose = scene.layout.position[0], scene.poses[m]
            return readings, bearing(pose, place), jnp.linalg.norm(place - pose[:2])

        return jax.lax.map(one, (keys, classes), batch_size=100)

    number = len(config.arena.classes)
    first = np.arange(SCENES) % number
    others = (first[:, None] + np.arange(config.arena.num_pois)) % number
    keys = jax.random.split(jax.random.key(seed), SCENES)
    found = map(np.asarray, record(keys, world, jnp.asarray(others)))
    return *found, np.array(config.label_of_class(config.modalities[m]))[first]


def answers(trained, m, readings, bearings, distances):
    """What `Models.detect` says."""
    _, _, models, world = trained
    sensor = world.sensors[m]
    detect = jax.jit(jax.vmap(lambda *look: models.detect(m, sensor, *look)))
    return detect(jnp.asarray(readings), jnp.asarray(bearings), jnp.asarray(distances))


def asserted(found):
    """Share of looks that are answered with a class."""
    return float(np.mean(found.is_there | (np.ptp(found.features, axis=1) > 0)))


def right(found, labels):
    """Share of the answers whose most likely label is true."""
    is_right = np.argmax(found.features, axis=1) == labels
    return float(is_right[np.asarray(found.is_there)].mean())


@pytest.mark.slow
@pytest.mark.parametrize("m", [0, 1])
def test_looks_inside_are_known_and_looks_outside_assert_no_class(trained, m):
    view = trained[1].viewpoint
    readings, bearings, distances, labels = scans(trained, m, view.min_distance, view.max_distance)
    found = answers(trained, m, readings, bearings, distances)
    flagged, share = 1 - float(found.is_known.mean()), right(found, labels)
    assert flagged <= 0.005
    assert share > (0.85 if trained[0] == "noisy" else 0.98)

    # Whole turns do not matter.
    for turns in (-1, 1):
        turned = answers(trained, m, readings, bearings + turns * 2 * np.pi, distances)
        same = np.abs(turned.features - found.features).max(axis=1) < 1e-4
        assert turned.is_known.all()
        # A bearing just between two windows may take the other one.
        assert same.mean() > 0.99

    for distance in (view.min_distance - 0.1, view.max_distance + 0.1):
        beyond = scans(trained, m, distance - 0.001, distance + 0.001, seed=1)[:3]
        found = answers(trained, m, *beyond)
        assert asserted(found) == 0
        assert not found.is_known.any()
