"""Clusters: found where points are apart, and named by most of their points."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsense.vae import clusters

KEY = jax.random.key(0)
PLACES = np.array([[0.0, 0.0], [3.0, 0.0], [0.0, 3.0], [3.0, 3.0], [9.0, 9.0]])


@pytest.mark.slow
def test_centres_are_found_wherever_the_starts_fall():
    of_point = np.repeat(np.arange(5), [400, 30, 400, 400, 5])
    noise = 0.1 * np.random.default_rng(0).normal(size=(len(of_point), 2))
    points = jnp.asarray(PLACES[of_point] + noise, jnp.float32)
    for seed in range(5):
        found = clusters.centres(jax.random.key(seed), points, 5)
        order = clusters.nearest(jnp.asarray(PLACES, jnp.float32), found)
        assert len(set(np.asarray(order).tolist())) == 5
        means = [points[of_point == i].mean(axis=0) for i in range(5)]
        np.testing.assert_allclose(found[order], np.stack(means), atol=1e-4)


def test_a_point_belongs_to_the_nearest_centre():
    centres = jnp.array([[0.0, 0.0], [4.0, 0.0]])
    points = jnp.array([[1.9, 5.0], [2.1, -5.0], [4.0, 0.0]])
    np.testing.assert_array_equal(clusters.nearest(points, centres), [0, 1, 1])


def test_no_two_classes_are_one_cluster():
    members, classes = jnp.array([0, 0, 0, 0, 0, 1, 2]), jnp.array([0, 0, 0, 1, 1, 2, 2])
    # Most of both are in the first cluster; it has three points of the first class.
    found = np.asarray(clusters.named(members, classes, 3))
    assert found[0] == 0
    assert sorted(found) == [0, 1, 2]


def test_a_class_is_the_cluster_with_most_of_its_points():
    members = jnp.array([2, 2, 0, 0, 0, 1, 2])
    classes = jnp.array([0, 0, 0, 1, 1, 2, 2])
    np.testing.assert_array_equal(clusters.named(members, classes, 3), [2, 0, 1])
