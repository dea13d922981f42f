"""Recorded looks next to simulated ones."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsense.config import PRESETS, ConfigError
from jaxsense.recorded import comparing

SMOKE = PRESETS["smoke"]
# Without noise, the error of the bearing alone tells windows apart.
EXACT = replace(SMOKE, lidar=replace(SMOKE.lidar, range_noise=0.0))


@pytest.fixture(scope="module")
def world():
    return comparing.make_world(EXACT, 2.0)


def test_walls_are_behind_the_poi(world):
    assert world.arena.config.side >= 4.0
    assert comparing.make_world(SMOKE, 0.5).arena.config == SMOKE.arena
    with pytest.raises(ConfigError, match=r"arena\.side"):
        comparing.make_world(replace(SMOKE, arena=replace(SMOKE.arena, side=101.0)), 0.5)


@pytest.mark.slow
def test_a_window_is_as_far_from_simulated_ones_as_it_is_off(world):
    bearing, distance = jnp.float32(0.2), jnp.float32(0.8)

    @jax.jit
    def compare(key, off):
        look_key, nearest_key = jax.random.split(key)
        window = comparing.simulate(look_key, world, 1, jnp.int32(CUBE), bearing, distance)
        return comparing.nearest(nearest_key, world, 1, window + off, bearing, distance)

    def compared(off):
        each = [compare(key, off) for key in jax.random.split(jax.random.key(3), 8)]
        return [np.stack(x) for x in zip(*each, strict=True)]

    _, residuals, usual = compared(0.0)
    window, off, same = compared(-0.2)
    apart = comparing.root_mean_square
    assert np.median(apart(residuals)) < 0.01
    assert np.median(apart(usual)) < 0.01
    # A cube's corner is nearer by .04 m than its side, which makes up for a part.
    assert 0.14 < np.median(apart(off)) < 0.2
    np.testing.assert_array_equal(same, usual)
    # What was recorded is the simulated window and the residuals, nearer and at the PoI alone.
    is_at_poi = np.isfinite(off)
    np.testing.assert_array_equal(is_at_poi, np.isfinite(usual))
    assert -0.21 < np.median(off[is_at_poi]) < -0.14
    # Both edges of a PoI of any shape, less the error of the bearing to either side.
    within = np.degrees(np.arcsin(0.1 / 0.8)) - 1
    np.testing.assert_allclose(is_at_poi.sum(axis=1), 2 * within / (240 / 682), atol=1.5)
    whole = (window + off)[is_at_poi]
    assert 0.4 < whole.min() < whole.max() < 0.7


def test_root_mean_squares_are_of_the_rays_at_the_poi():
    residuals = jnp.array([[jnp.nan, 0.3, -0.4, jnp.nan], [0.2, 0.2, 0.2, 0.2]])
    # sqrt((.09 + .16) / 2), sqrt(.04).
    np.testing.assert_allclose(comparing.root_mean_square(residuals), [0.125**0.5, 0.2], rtol=1e-6)
