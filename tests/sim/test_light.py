"""The light of a scene, and how it changes: moments and correlations over many scenes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsense.sim.light import Conditions, random_conditions, random_light

NUMBER = 20_000
KEYS = jax.random.split(jax.random.key(0), NUMBER)
SOMEWHERE = np.array([1.0, -2.0, 3.0])


@pytest.fixture(scope="module")
def conditions():
    """Those of many scenes."""
    return jax.jit(jax.vmap(random_conditions))(KEYS)


@pytest.fixture(scope="module")
def values(conditions):
    """`[NUMBER, P, 8]` conditions of many scenes at some points."""
    at = jax.jit(jax.vmap(lambda scene, point: scene.at(point), (0, None)))

    def of_scenes(*points):
        each = [at(conditions, jnp.array(point, jnp.float32)) for point in points]
        return np.stack(each, axis=1)

    return of_scenes


def test_random_light_is_a_unit_vector_from_20_to_70_degrees():
    light = jax.jit(jax.vmap(random_light))(jax.random.split(jax.random.key(0), 500))
    np.testing.assert_allclose(np.linalg.norm(light.direction, axis=-1), 1.0, atol=1e-6)
    height = np.degrees(np.arcsin(light.direction[:, 2]))
    assert 20 <= height.min() < 22
    assert 68 < height.max() <= 70.001
    for quarter in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
        assert (np.sign(light.direction[:, :2]) == quarter).all(axis=-1).mean() > 0.15
    # Between the weakest and the strongest light, to within 1 % of 500 draws.
    for strength, low, high in ((light.diffuse, 0.2, 0.8), (light.ambient, 0.3, 0.6)):
        assert low <= strength.min() < low + 0.02 * (high - low)
        assert high - 0.02 * (high - low) < strength.max() <= high + 1e-6


def test_hand_worked_conditions():
    # One wave of 2 rad per unit of x and 1 of time: at (.5, 9, 2) its phase is 3.
    weights = jnp.stack([jnp.array([1.0, 0.0]), jnp.array([0.5, 2.0])])
    conditions = Conditions(jnp.array([[2.0, 0.0, 1.0]]), weights)
    found = conditions.at(jnp.array([0.5, 9.0, 2.0]))
    expected = [np.cos(3), 0.5 * np.cos(3) + 2 * np.sin(3)]
    np.testing.assert_allclose(found, expected, rtol=1e-6)


def test_conditions_are_independent_standard_normal_values_anywhere(values):
    for point in (np.zeros(3), SOMEWHERE, [20.0, -20.0, 60.0]):
        found = values(point)[:, 0]
        # Standard errors of 20,000 draws: .007 of a mean, .01 of a variance, .035 of the fourth
        # moment, which is 3.
        np.testing.assert_allclose(found.mean(axis=0), 0.0, atol=0.03)
        np.testing.assert_allclose(np.cov(found.T), np.eye(8), atol=0.045)
        np.testing.assert_allclose((found**2).mean() ** 2, 1.0, atol=0.02)
        assert (found**4).mean() == pytest.approx(3.0, abs=0.07)


@pytest.mark.parametrize("axis", range(3))
def test_conditions_correlate_less_the_further_apart(values, axis):
    distances = [0.0, 0.02, 0.5, 1.0, 2.0, 4.0]
    found = values(*(SOMEWHERE + distance * np.eye(3)[axis] for distance in distances))
    correlation = (found * found[:, :1]).mean(axis=(0, 2))
    # exp(-d^2 / 2): 1, .9998, .8825, .6065, .1353, .0003.
    expected = np.exp(-np.square(distances) / 2)
    np.testing.assert_allclose(correlation, expected, atol=0.015)
    assert np.abs(found[:, 1] - found[:, 0]).max() < 0.2  # 5 to 10 times the deviation of .02
