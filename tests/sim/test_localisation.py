"""Errors of the poses that robots believe they have, in missions and in the looks of training."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsense import PRESETS
from jaxsense.config.mission import LocalisationConfig
from jaxsense.sim import localisation, world


def test_constant_errors_have_their_standard_deviations():
    config = LocalisationConfig(error=(0.03, 2.0))
    errors = np.asarray(localisation.draw(jax.random.key(0), config, 20_000))
    expected = [0.03, 0.03, np.radians(2.0)]
    np.testing.assert_allclose(errors.std(axis=0), expected, rtol=0.02)
    np.testing.assert_allclose(errors.mean(axis=0) / expected, 0.0, atol=0.03)
    np.testing.assert_allclose(np.corrcoef(errors.T), np.eye(3), atol=0.03)
    np.testing.assert_array_equal(
        localisation.draw(jax.random.key(0), LocalisationConfig(), 3), np.zeros((3, 3))
    )


def test_drift_grows_with_the_root_of_the_distance():
    config = LocalisationConfig(drift=(0.02, 1.0))
    before = jnp.full((20_000, 3), 0.5)
    for driven in (1.0, 0.25, 4.0):
        after = localisation.drift(jax.random.key(0), config, before, jnp.full(len(before), driven))
        expected = driven**0.5 * np.array([0.02, 0.02, np.radians(1.0)])
        np.testing.assert_allclose((after - before).std(axis=0), expected, rtol=0.02)
    still = localisation.drift(jax.random.key(0), config, before, jnp.zeros(len(before)))
    np.testing.assert_array_equal(still, before)


@pytest.mark.parametrize(
    ("pose", "error", "expected"),
    [
        # It believes to be 0.1 m further east, and so stops 0.1 m short.
        ([0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.9, 0.0]),
        # It faces east and believes to face north: what it has on its right is south of it.
        ([0.0, 0.0, 0.0], [0.0, 0.0, np.pi / 2], [0.0, -1.0]),
        # From (0, 0) it believes to be at (0, 1): (1, 0) is (1, -1) away, which it turns by -90
        # degrees to (-1, -1).
        ([0.0, 0.0, 2.0], [0.0, 1.0, np.pi / 2], [-1.0, -1.0]),
    ],
)
def test_a_robot_heads_for_where_its_error_leads(pose, error, expected):
    found = localisation.aimed_at(jnp.array([1.0, 0.0]), jnp.array(pose), jnp.array(error))
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_variances_of_places_as_worked_by_hand():
    errors = LocalisationConfig(error=(0.03, 2.0), drift=(0.01, 0.5))
    found = localisation.variance(errors, jnp.float32(16.0), jnp.array([0.0, 2.0]))
    heading = np.radians(2.0) ** 2 + 16 * np.radians(0.5) ** 2
    of_one = 0.03**2 + 16 * 0.01**2 + heading * np.array([0.0, 4.0])
    np.testing.assert_allclose(found, 2 * of_one, rtol=1e-5)


@pytest.fixture(scope="module")
def simulation():
    return world.make_world(PRESETS["smoke"])


def test_looks_of_training_have_errors_only_if_they_are_asked_for(simulation):
    for in_training in (False, True):
        errors = LocalisationConfig(in_training=in_training, error=(0.01, 2.0))
        mission = replace(PRESETS["smoke"].mission, localisation=errors)
        found = world.make_world(replace(PRESETS["smoke"], mission=mission))
        assert found.localisation == (errors if in_training else None)
        assert found.arena is simulation.arena


def test_training_looks_have_the_bearing_and_distance_of_a_misplaced_robot(simulation):
    errors = LocalisationConfig(error=(0.01, 2.0))
    keys = jax.random.split(jax.random.key(0), 20_000)

    @jax.jit
    @jax.vmap
    def believed(key):
        pose, place = jnp.array([1.0, 2.0, 0.3]), jnp.array([1.5, 2.0])
        misplaced = replace(simulation, localisation=errors)
        return world._believed(key, misplaced, pose, jnp.float32(0.1), place)

    bearing, distance = believed(keys)
    # 0.01 m across a view of 0.5 m are 1.15 degrees, and 2 of the heading: together 2.31.
    assert np.degrees(np.std(bearing)) == pytest.approx(2.31, rel=0.02)
    assert np.mean(bearing) == pytest.approx(0.1, abs=0.002)
    assert np.std(distance) == pytest.approx(0.01, rel=0.02)
    assert np.mean(distance) == pytest.approx(0.5, abs=0.001)
