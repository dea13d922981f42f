"""Recorded looks next to simulated ones."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsense.config import PRESETS, ConfigError
from jaxsense.recorded import RecordedLooks
from jaxsense.recorded import looks as comparing

SMOKE = PRESETS["smoke"]
CUBE = 2
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


def test_a_window_is_of_a_lone_poi_at_a_bearing_and_distance(world):
    simulate = jax.jit(comparing.simulate, static_argnums=2)
    for cls in (0, CUBE):
        look = jnp.int32(cls), jnp.float32(0.2), jnp.float32(0.8)
        found = np.asarray(simulate(jax.random.key(1), world, 1, *look))
        # In the middle its near side, .1 to .1414 before the centre; at the ends the limit.
        assert 0.8 - 0.1415 < found[len(found) // 2] < 0.8 - 0.099
        np.testing.assert_array_equal(found[[0, -1]], world.sensors[1].window_limit)
        # As wide as it is, whose bearing is off by a degree at most.
        hit = np.flatnonzero(found < 0.9)
        width = np.radians(240 / 682) * len(hit)
        assert 2 * np.arcsin(0.1 / 0.8) - 0.01 < width < 2 * np.arcsin(0.1415 / 0.8) + 0.01
        assert abs(hit.mean() - (len(found) - 1) / 2) * 240 / 682 < 1.3


def test_the_nearest_window_and_its_residuals_as_worked_by_hand(world, monkeypatch):
    # Windows of the classes are 1, 2 and 3 m: of 5, the first is compared with the other 4.
    monkeypatch.setattr(comparing, "NUM_SIMULATED", 4)
    size = world.sensors[1].window
    simulate = lambda key, world, modality, poi_class, *_: jnp.full(size, 1.0 + poi_class)  # noqa: E731
    monkeypatch.setattr(comparing, "simulate", simulate)
    look = jnp.full(size, 2.75), jnp.float32(0.2), jnp.float32(0.8)
    found, residuals, usual = comparing.nearest(jax.random.key(0), world, 1, *look)
    np.testing.assert_array_equal(found, 3.0)
    is_at_poi = np.isfinite(residuals)
    np.testing.assert_array_equal(residuals[is_at_poi], -0.25)
    np.testing.assert_array_equal(usual[is_at_poi], 0.0)
    np.testing.assert_array_equal(np.isfinite(usual), is_at_poi)
    # Both edges of a PoI of any shape, less the error of the bearing to either side.
    within = np.degrees(np.arcsin(0.1 / 0.8)) - 1
    np.testing.assert_allclose(is_at_poi.sum(), 2 * within / (240 / 682), atol=1.5)


def test_windows_that_were_recorded_completely_are_compared(monkeypatch):
    nearest = lambda key, world, modality, window, *look: (window + 1, window * 2, window * 3)  # noqa: E731
    monkeypatch.setattr(comparing, "nearest", nearest)
    scans = np.full((4, 683), 0.5)
    scans[1, 341] = np.nan  # in the window
    scans[2] = 0.25
    places, poses = np.tile([1.0, 0.0], (4, 1)), np.zeros((4, 3))
    poses[3, 2] = np.pi  # looks away
    found = comparing.compare(SMOKE, RecordedLooks(places, {"lidar": poses}, {"lidar": scans}))
    (one,) = found.values()
    assert [*found] == ["lidar"]
    np.testing.assert_allclose(one.recorded, np.repeat([[0.5], [0.25]], 128, axis=1))
    np.testing.assert_allclose(one.simulated, one.recorded + 1)
    np.testing.assert_allclose(one.residuals, one.recorded * 2)
    # Root mean squares of 1 and .5, and of 1.5 and .75; and the median of 128 times 1 and .5.
    assert str(one).startswith("2 recorded windows are 0.7500 from the nearest of 96 simulated")
    assert str(one).endswith("median residual of +0.7500; simulated ones are 1.1250 away")


def test_root_mean_squares_are_of_the_rays_at_the_poi():
    residuals = jnp.array([[jnp.nan, 0.3, -0.4, jnp.nan], [0.2, 0.2, 0.2, 0.2]])
    # sqrt((.09 + .16) / 2), sqrt(.04).
    np.testing.assert_allclose(comparing.root_mean_square(residuals), [0.125**0.5, 0.2], rtol=1e-6)
