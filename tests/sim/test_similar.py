"""Simulated looks like recorded ones."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsense.config import PRESETS, ConfigError
from jaxsense.sim import similar, windows

SMOKE = PRESETS["smoke"]
# Without noise, the error of the bearing alone tells windows apart.
EXACT = replace(SMOKE, lidar=replace(SMOKE.lidar, range_noise=0.0))
CYLINDER, CUBE = 0, 2


@pytest.fixture(scope="module")
def world():
    return similar.make_world(EXACT, 2.0)


def test_walls_are_behind_the_poi(world):
    assert world.arena.config.side >= 4.0
    assert similar.make_world(SMOKE, 0.5).arena.config == SMOKE.arena
    with pytest.raises(ConfigError, match=r"arena\.side"):
        similar.make_world(replace(SMOKE, arena=replace(SMOKE.arena, side=101.0)), 0.5)


@pytest.mark.slow
@pytest.mark.parametrize(("bearing", "distance"), [(0.0, 2.0), (-1.2, 0.5)])
def test_a_simulated_look_shows_a_lone_poi_where_it_is_expected(world, bearing, distance):
    look = jax.jit(
        lambda key: similar.simulate(
            key, world, 1, jnp.int32(CYLINDER), jnp.float32(bearing), jnp.float32(distance)
        )
    )
    ranges = np.stack([look(key) for key in jax.random.split(jax.random.key(0), 10)])
    np.testing.assert_allclose(ranges.min(axis=1), distance - 0.1, atol=2e-3)
    # As many beams as arcsin(radius / distance) to either side; walls are behind.
    near = (ranges < distance).sum(axis=1) * np.radians(240 / 682)
    np.testing.assert_allclose(near, 2 * np.arcsin(0.1 / distance), atol=np.radians(0.8))
    middle = np.array([np.flatnonzero(x < distance).mean() for x in ranges]) - 63.5
    assert 0.3 < np.abs(middle).max() * 240 / 682 < 1.4  # degrees


@pytest.mark.slow
def test_a_window_is_as_far_from_simulated_ones_as_it_is_off(world):
    bearing, distance = jnp.float32(0.2), jnp.float32(0.8)
    sensor = world.sensors[1]

    @jax.jit
    def compare(key, off):
        look_key, nearest_key = jax.random.split(key)
        look = similar.simulate(look_key, world, 1, jnp.int32(CUBE), bearing, distance)
        window = windows.as_window(sensor, look + off)
        return similar.nearest(nearest_key, world, 1, window, bearing, distance)

    keys = jax.random.split(jax.random.key(3), 8)
    found = jax.tree.map(lambda *x: np.stack(x), *(compare(key, 0.0) for key in keys))
    apart = similar.root_mean_square
    assert np.median(apart(found.recorded)) < 0.01
    assert np.median(apart(found.simulated)) < 0.01
    off = jax.tree.map(lambda *x: np.stack(x), *(compare(key, -0.2) for key in keys))
    # A cube's corner is nearer by .04 m than its side, which makes up for a part.
    assert 0.14 < np.median(apart(off.recorded)) < 0.2
    np.testing.assert_array_equal(off.simulated, found.simulated)
    assert found.window.shape == (8, 128)
    # What was recorded is the simulated window and the residuals, nearer and at the PoI alone.
    is_at_poi = np.isfinite(off.recorded)
    np.testing.assert_array_equal(is_at_poi, np.isfinite(off.simulated))
    assert -0.21 < np.median(off.recorded[is_at_poi]) < -0.14
    # Both edges of a PoI of any shape, less the error of the bearing to either side.
    within = np.degrees(np.arcsin(0.1 / 0.8)) - 1
    np.testing.assert_allclose(is_at_poi.sum(axis=1), 2 * within / (240 / 682), atol=1.5)
    whole = off.window + off.recorded
    assert 0.4 < whole[is_at_poi].min() < whole[is_at_poi].max() < 0.7


def test_root_mean_squares_are_of_the_rays_at_the_poi():
    residuals = jnp.array([[jnp.nan, 0.3, -0.4, jnp.nan], [0.2, 0.2, 0.2, 0.2]])
    # sqrt((.09 + .16) / 2), sqrt(.04).
    np.testing.assert_allclose(similar.root_mean_square(residuals), [0.125**0.5, 0.2], rtol=1e-6)
