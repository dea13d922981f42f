"""Candidates in scans by hand, and in simulated scans of unknown scenes."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsense import sim
from jaxsense.config.presets import PRESETS
from jaxsense.exploration import proposals
from jaxsense.sim import sensors, world

CAMERA, LIDAR = sensors.make(PRESETS["default"])
CIRCLE = dataclasses.replace(LIDAR, rays=sim.raycast.Fan(720, 359.5))
ANGLES, RADIUS, ORIGIN = LIDAR.angles, 0.1, jnp.zeros(3)
NOTHING = jnp.zeros((0, 4)), jnp.zeros((0, 3))
WALLS = jnp.array([[-4, -4, 4, -4], [4, -4, 4, 4], [4, 4, -4, 4], [-4, 4, -4, -4.0]])


def polygon(corners):
    """Ranges to the sides of a polygon, infinite without a hit."""
    cos, sin, ranges = np.cos(ANGLES), np.sin(ANGLES), np.full(len(ANGLES), np.inf)
    for (x, y), end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        # r (cos, sin) = (x, y) + s (u, v), by Cramer's rule.
        (u, v), scale = end - (x, y), cos * (end[1] - y) - sin * (end[0] - x) + 1e-12
        along, share = (x * v - y * u) / scale, (x * sin - y * cos) / scale
        ranges = np.where((along > 0) & (abs(share - 0.5) < 0.5), np.minimum(ranges, along), ranges)
    return ranges


def cube(x, y, degrees=0.0):
    corner = np.radians(degrees + 45 + 90 * np.arange(4))[:, None]
    offsets = 2**0.5 * RADIUS * np.concatenate([np.cos(corner), np.sin(corner)], axis=1)
    return polygon(np.array([x, y]) + offsets)


def cylinder(angles, bearing, distance):
    # |r u - c| = R: r = d cos(a) - sqrt(R^2 - d^2 sin(a)^2), a from the bearing of the centre.
    cos, inside = np.cos(angles - bearing), RADIUS**2 - (distance * np.sin(angles - bearing)) ** 2
    is_hit = (inside > 0) & (cos > 0)
    return np.where(is_hit, distance * cos - np.sqrt(np.maximum(inside, 0)), np.inf)


def found(readings, sensor=LIDAR, pose=ORIGIN):
    given = sensor, jnp.float32(readings), jnp.asarray(pose), *NOTHING, RADIUS
    made = proposals.propose(*given, number=4)
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(made))
    return jax.tree.map(lambda x: np.asarray(x)[np.asarray(made.is_valid)], made)


@pytest.mark.parametrize(("bearing", "sensor"), [(0.4, LIDAR), (3.1, CIRCLE), (-3.1, CIRCLE)])
def test_a_cylinder_is_found_where_it_is(bearing, sensor):
    made = found(cylinder(sensor.angles, bearing, 1.5), sensor, pose=(1.0, 2.0, np.pi / 2))
    np.testing.assert_allclose([*made.bearing, *made.distance], [bearing, 1.5], atol=0.008)
    # Turned by 90 degrees, (x, y) becomes (-y, x).
    expected = [[1 - 1.5 * np.sin(bearing), 2 + 1.5 * np.cos(bearing)]]
    np.testing.assert_allclose(made.position, expected, atol=0.01)


@pytest.mark.parametrize("degrees", [0.0, 20.0, 45.0, 70.0])
def test_a_turned_cube_is_found_where_it_is(degrees):
    np.testing.assert_allclose(found(cube(1.2, -0.5, degrees)).position, [[1.2, -0.5]], atol=0.012)


def test_what_is_no_body_in_the_open_is_none():
    wall = polygon(np.array([[2, -1], [2, 0.3], [2.05, 0.3], [2.05, -1]]))
    behind = np.minimum(wall, polygon(np.array([[1, -1], [1, 0.05], [1.1, 0.05]])))
    assert 1.9 < behind[np.argmin(abs(ANGLES - 0.1))] < 2.1  # 20 cm of the wall are in sight
    body = np.where(np.arange(len(ANGLES)) < 12, 1.5, np.inf)  # the field of view cuts it
    unknown = np.where(ANGLES < -0.03, np.nan, cylinder(ANGLES, 0.0, 1.5))
    for ranges in (wall, behind, body, unknown, np.full(len(ANGLES), 5.0), 0 * ANGLES):
        assert not found(ranges).is_valid.size


def test_two_bodies_5_cm_apart_are_two_the_nearest_first():
    ranges = np.minimum(cube(1.3, 0.125), cube(1.25, -0.125))
    made = found(np.minimum(ranges, polygon(np.asarray(WALLS[:, :2]))))
    np.testing.assert_allclose(made.position, [[1.25, -0.125], [1.3, 0.125]], atol=0.02)


def test_known_walls_and_circles_explain_beams():
    # The beams end at (1, 0), 1 cm from the circle, and at (4, 0) on a wall; one has no end.
    angles, ranges = np.array([0.0, np.pi, 1.0]), jnp.array([2.0, 1.0, jnp.inf])
    known = WALLS, jnp.array([[1.0, 0.1, 0.09]])
    explained = proposals.explained_by(jnp.array([3.0, 0.0, np.pi]), angles, ranges, *known)
    np.testing.assert_array_equal(explained, [True, True, False])


def test_coloured_intervals_are_found():
    # Red and yellow touch, green is cut. 1.15 * .1 / sin(5) = 1.319 m, and 1.100 m for 6 degrees.
    degrees, light = np.degrees(CAMERA.angles)[:, None], np.array([0.6, 0.5, 0.4])
    image = np.where(degrees < -36, 0.2, 0.6) * light[None]
    bodies = (20, 5, "red"), (9, 6, "yellow"), (-20, 5, "blue"), (40, 5, "green")
    for middle, half, colour in bodies:
        albedo = np.array(PRESETS["default"].arena.colours[colour])
        image = np.where(abs(degrees - middle) < half, albedo * light, image)
    made = found(image, CAMERA)
    np.testing.assert_allclose(np.sort(np.degrees(made.bearing)), [-20, 9, 20], atol=0.2)
    np.testing.assert_allclose(np.sort(made.distance), [1.1, 1.319, 1.319], rtol=0.02)
    short, long = np.linalg.eigvalsh(made.covariance).T
    assert np.all(long > 10 * short)


def test_the_gradient_of_the_distance_is_that_of_a_translation():
    def distance(ranges):
        return proposals.propose(LIDAR, ranges, ORIGIN, *NOTHING, RADIUS, 1).distance[0]

    gradient = jax.grad(distance)(jnp.float32(cylinder(ANGLES, 0.4, 1.5)))
    assert np.isfinite(gradient).all()
    np.testing.assert_allclose(gradient.sum(), 1.0, atol=0.01)


@pytest.mark.parametrize(("index", "reach", "least"), [(1, 2.5, 0.99), (0, 2.0, 0.95)])
def test_bodies_of_simulated_scenes_are_found(index, reach, least):
    base = PRESETS["noisy" if index else "default"]
    config = dataclasses.replace(base, arena=dataclasses.replace(base.arena, side=8.0, num_pois=8))
    made = world.make_world(config)
    sensor, extent = made.sensors[index], config.arena.poi_extent

    def look(key):
        scene_key, noise_key = jax.random.split(key)
        scene = world.random_scene(scene_key, made, jnp.arange(8) % 3)
        place, data = scene.layout, sim.place(made.arena, scene.layout, scene.poses)
        given = made.arena, data, place, scene.light, index, sensor.directions
        robot = jnp.append(scene.poses[1 - index, :2], 0.06)
        readings = sensors.scan(noise_key, sensor, *given)
        seen = sensor, readings, scene.poses[index], WALLS, robot[None]
        bodies = jnp.concatenate([place.position, robot[None, :2]])
        return bodies, scene.poses[index], proposals.propose(*seen, RADIUS, 8)

    keys = jax.random.split(jax.random.key(3), 200)
    bodies, pose, batch = jax.tree.map(np.asarray, jax.jit(jax.vmap(look))(keys))
    for each, of_all in zip(*map(jax.tree.leaves, (jax.jit(look)(keys[0])[2], batch)), strict=True):
        np.testing.assert_allclose(each, of_all[0], atol=1e-4)
    # In the field of view and not beside another body, which may hide it.
    distance = np.linalg.norm(bodies - pose[:, None, :2], axis=-1)
    half = np.arcsin(np.minimum(extent / distance, 1))
    bearing = np.arctan2(*np.moveaxis(bodies - pose[:, None, :2], -1, 0)[::-1]) - pose[:, None, 2]
    bearing = (bearing + np.pi) % (2 * np.pi) - np.pi
    shown = (distance < reach) & (abs(bearing) + half < np.radians(sensor.field_of_view) / 2)
    off = abs(bearing[:, :, None] - bearing[:, None]) + 10 * np.eye(9)[None]
    shown &= (off > half[:, :, None] + half[:, None] + 0.01).all(axis=-1)
    # A LiDAR finds positions within .1 m, a camera bearings within 2 degrees.
    error, limit = np.linalg.norm(batch.position[:, None] - bodies[:, :8, None], axis=-1), 0.1
    if not index:
        error, limit = abs(bearing[:, :8, None] - batch.bearing[:, None]), np.radians(2)
    error = np.where(batch.is_valid[:, None], error, np.inf)
    nearest = error.min(axis=2)[shown[:, :8]]
    assert len(nearest) > 100
    assert np.mean(nearest < limit) >= least
    assert np.median(nearest) < 0.012
    assert np.quantile(nearest[nearest < limit], 0.95) < 0.03
    is_false = batch.is_valid & ~(error < np.maximum(limit, (1 - index) * half[:, :8, None])).any(
        axis=1
    )
    assert is_false.sum() / len(keys) <= 0.02
