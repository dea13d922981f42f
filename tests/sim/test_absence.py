"""Looks that do not show their PoI, by what their rays hit."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsense import sim
from jaxsense.config import Config
from jaxsense.sim import arena as arenas
from jaxsense.sim import viewpoints, windows, world
from jaxsense.sim.viewpoints import bearing

CONFIG = Config()
NUM_LOOKS = 400
CAMERA, LIDAR = 0, 1


@pytest.fixture(scope="module", params=[pytest.param(CAMERA, marks=pytest.mark.slow), LIDAR])
def looks(request):
    """A robot, changed looks at the first PoI, and of each window's rays hits and angles."""
    robot, simulation = request.param, world.make_world(CONFIG)

    def look(key):
        scene_key, look_key, change_key = jax.random.split(key, 3)
        scene = world.random_scene(scene_key, simulation, jnp.array([0, 1, 2]))
        _, scene = world.look(look_key, simulation, scene, robot, jnp.int32(0))
        pose, place = scene.poses[robot], scene.layout.position[0]
        before = viewpoints.View(
            positions=scene.layout.position,
            poses=scene.poses,
            twin=jnp.array(viewpoints.outside(CONFIG.arena)),
            bearing=bearing(pose, place),
            distance=jnp.linalg.norm(place - pose[:2]),
        )
        arena, sensors = CONFIG.arena, simulation.sensors
        poi = jnp.int32(0)
        view = viewpoints.without_poi(
            change_key, sensors, arena, CONFIG.viewpoint, before, robot, poi
        )
        layout = dataclasses.replace(scene.layout, position=view.positions)
        data = arenas.place(simulation.arena, layout, view.poses)
        sensor = sensors[robot]
        section = sim.cross_section(simulation.arena, data, sensor.height, robot)
        angles = windows.around(sensor, sensor.angles, view.bearing)
        hits = sim.cast(section, view.poses[robot, :2], view.poses[robot, 2] + angles)
        poi_of_geom = jnp.array(simulation.arena.poi_of_geom)
        is_poi = (hits.geom >= 0) & (poi_of_geom[hits.geom] == 0)
        return before, view, is_poi, angles

    keys = jax.random.split(jax.random.key(0), NUM_LOOKS)
    return robot, *jax.device_get(jax.jit(jax.vmap(look))(keys))


def test_no_changed_look_shows_its_poi_in_the_middle_of_the_window(looks):
    _, _, view, is_poi, angles = looks
    away = viewpoints.outside(CONFIG.arena)
    has_twin = np.any(view.twin != away, axis=-1)
    is_middle = np.abs(angles - view.bearing[:, None]) < np.radians(1.0)
    shows = (is_poi & is_middle).any(axis=1)
    # Only where another robot, which these rays ignore, stands in between.
    assert not shows[~has_twin].any()
    assert shows[has_twin].any()


def test_every_situation_is_drawn(looks):
    robot, before, view, _, _ = looks
    away = viewpoints.outside(CONFIG.arena)
    inside = np.abs(view.poses[:, robot, :2]).max(axis=-1) < CONFIG.arena.side / 2
    moved = np.any(view.poses[:, robot] != before.poses[:, robot], axis=-1)
    gone = np.all(view.positions[:, 0] == away, axis=-1)
    # Of 13 parts: 2 empty, 3 walls, 1 outside, 2 off, 2 covered, 3 robots.
    for found, parts in (
        (~inside, 1),
        (inside & moved, 3),
        (view.bearing != before.bearing, 2),
        (gone & ~moved, 5),
    ):
        assert found.mean() == pytest.approx(parts / 13, abs=0.06)
    # It draws the distance anew where there is no PoI.
    near, far = CONFIG.viewpoint.min_distance, CONFIG.viewpoint.max_distance
    assert (view.distance[gone] >= near).all()
    assert (view.distance[gone] <= far).all()
    assert (view.distance == before.distance)[~gone].all()
    assert (np.abs(view.bearing) <= np.radians((40.0, 120.0)[robot])).all()
