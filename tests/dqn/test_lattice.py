"""The lattice of class probabilities, and how a table on it is read."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsense.dqn import optimum

NUM_CLASSES = (1, 2, 3, 4, 6, 15)
interpolate = jax.jit(jax.vmap(optimum.interpolate, in_axes=(None, 0)))


@pytest.mark.parametrize("number", NUM_CLASSES)
def test_the_lattice_holds_every_point_of_whole_steps_once(number):
    steps, points = optimum.steps_of_lattice(number), optimum.lattice(number)
    # Steps divided among the classes: bars between them in any of steps + C - 1 places.
    assert points.shape == (math.comb(steps + number - 1, number - 1), number)
    whole = np.round(points * steps)
    np.testing.assert_allclose(points * steps, whole, atol=1e-9)
    assert np.all(whole >= 0)
    np.testing.assert_array_equal(whole.sum(axis=1), steps)
    assert len(np.unique(whole, axis=0)) == len(points)


def test_the_more_classes_the_fewer_steps_and_never_more_than_8192_points():
    # 512 at most; 127 x 128 / 2 = 8128, 128 x 129 / 2 = 8256; of 15 classes C(18, 4) = 3060 points,
    # not C(19, 5) = 11,628.
    assert [optimum.steps_of_lattice(n) for n in (1, 2, 3, 15)] == [512, 512, 126, 4]


@pytest.mark.parametrize("number", NUM_CLASSES)
def test_a_point_of_the_lattice_reads_its_own_row(number):
    points = optimum.lattice(number)
    rows = jnp.arange(len(points), dtype=jnp.float32)
    # To within the rounding of a probability, 6e-8, times the steps and the difference of two rows.
    np.testing.assert_allclose(interpolate(rows, jnp.array(points, jnp.float32)), rows, atol=0.5)
    steps = optimum.steps_of_lattice(number)
    sums = np.round(steps * np.cumsum(points[:, ::-1], axis=1)[:, ::-1][:, 1:]).astype(int)
    np.testing.assert_array_equal(optimum._rows(sums, steps), np.arange(len(points)))


@pytest.mark.parametrize("number", NUM_CLASSES)
def test_a_linear_function_is_read_exactly_between_the_points(number):
    random = np.random.default_rng(number)
    slopes = random.normal(size=number)
    table = jnp.array(optimum.lattice(number) @ slopes, jnp.float32)
    inside = random.dirichlet(np.ones(number), 200)
    # And on the faces, where some classes are impossible.
    edges = random.dirichlet(np.full(number, 0.05), 200)
    for weights in (inside, edges, np.eye(number)):
        found = interpolate(table, jnp.array(weights, jnp.float32))
        np.testing.assert_allclose(found, weights @ slopes, atol=1e-5)
