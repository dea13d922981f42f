"""Second viewpoints at a given distance from the first, and looks from there."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsense.config import PRESETS, ViewpointConfig
from jaxsense.sim import viewpoints, world
from jaxsense.sim.arena import make_layout

CONFIG = PRESETS["smoke"]
POSITIONS = jnp.array([[0.0, 0.0], [1.2, 1.2], [-1.2, 1.2]])
PLACE = jnp.array([0.6, 0.0])


@pytest.fixture(scope="module")
def moved():
    layout = make_layout(CONFIG.arena, POSITIONS, np.zeros(3), np.zeros(3, np.int32))

    @jax.jit
    def draw(keys, distance, others):
        return jax.vmap(
            lambda key: viewpoints.moved_viewpoint(
                key, ViewpointConfig(), CONFIG.arena, layout, others, jnp.int32(0), PLACE, distance
            )
        )(keys)

    keys = jax.random.split(jax.random.key(0), 64)
    return lambda distance, others: draw(keys, jnp.float32(distance), jnp.array(others))


def test_second_viewpoints_are_at_the_distance_in_range_and_face_the_poi(moved):
    poses, believed = moved(0.4, [[1.4, -1.4]])
    np.testing.assert_allclose(np.hypot(*(poses[:, :2] - PLACE[None]).T), 0.4, rtol=1e-5)
    to_poi = np.hypot(*poses[:, :2].T)
    assert np.all((to_poi >= 0.3) & (to_poi <= 1.2))
    assert np.ptp(np.arctan2(poses[:, 1], poses[:, 0] - 0.6)) > 1
    found = jax.vmap(lambda pose: viewpoints.bearing(pose, POSITIONS[0]))(poses)
    assert np.all(np.abs(found) <= np.radians(20) + 1e-5)
    # The robot knows the bearing to one degree.
    assert 0 < np.abs(found - believed).max() <= np.radians(1) + 1e-5


def test_where_no_place_is_free_at_that_distance_the_robot_stays(moved):
    # 2 m from there, nothing is within 1.2 m of the PoI.
    poses, _ = moved(2.0, [[1.4, -1.4]])
    np.testing.assert_array_equal(poses[:, :2], np.broadcast_to(PLACE, (64, 2)))
    # Another robot stands where it would go.
    ring = [[0.6 + 0.1 * np.cos(a), 0.1 * np.sin(a)] for a in np.linspace(0, 6, 8)]
    poses, _ = moved(0.1, ring)
    np.testing.assert_array_equal(poses[:, :2], np.broadcast_to(PLACE, (64, 2)))


@pytest.mark.slow
def test_looks_from_one_place_are_alike_but_for_their_noise():
    simulation = world.make_world(CONFIG)

    @jax.jit
    def look_twice(key):
        scene_key, first_key, second_key = jax.random.split(key, 3)
        scene = world.random_scene(scene_key, simulation, jnp.array([0, 1, 2]))
        (first, _), seen = world.look(first_key, simulation, scene, 1, jnp.int32(0))
        second, _, place = world.look_again(second_key, simulation, seen, 1, jnp.int32(0), 2.0)
        return first, second, jnp.linalg.norm(place - seen.poses[1, :2])

    each = jax.jit(jax.vmap(look_twice))(jax.random.split(jax.random.key(1), 256))
    first, second, distance = map(np.asarray, each)
    nearest = first.min(axis=1), second.min(axis=1)
    apart = np.abs(nearest[0] - nearest[1])
    # From a place 1 cm away the PoI is as far, up to the noise of 1 cm and 6 cm less or more.
    assert np.all(apart[distance < 0.01] < 0.06)
    assert np.all(apart <= distance + 0.1)
    assert 0.1 < np.mean(distance < 0.01) < 0.4
    assert np.mean(distance > 0.5) > 0.05
