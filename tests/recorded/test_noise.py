"""The noise of a LiDAR, fitted to scans."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsense import recorded
from jaxsense.config import LidarConfig
from jaxsense.recorded import noise as noises
from jaxsense.sim import raycast, sensors

ANGLES = np.radians(np.linspace(-90, 90, 361)).astype(np.float32)


def rooms(noise, number=1500):
    """Scans of rooms with a pillar, by a scanner with known noise."""
    angles = jnp.asarray(ANGLES)

    @jax.jit
    @jax.vmap
    def scan(key):
        place_key, noise_key = jax.random.split(key)
        x, y, turn, size = jax.random.uniform(place_key, (4,))
        centre = jnp.stack([jnp.array([1.2, y - 0.5]), jnp.array([x - 0.5, y - 0.5])])
        axis = jnp.stack([jnp.array([1.0, 0.0]), jnp.stack([jnp.cos(turn), jnp.sin(turn)])])
        half = jnp.stack([jnp.full(2, 0.3), jnp.stack([3.0 + size, 3.0 + x])])
        section = raycast.CrossSection(centre, axis, half, (0, 1), 0)
        distance = raycast.cast(section, jnp.zeros(2), angles).distance
        return sensors.measured_ranges(noise_key, distance, noise)

    ranges = np.asarray(scan(jax.random.split(jax.random.key(0), number)))
    return np.where(ranges >= noise.max_range, np.inf, ranges)


@pytest.fixture(scope="module")
def measured():
    noise = LidarConfig(range_noise=0.006, range_noise_growth=0.001, mixed_pixels=0.1, dropout=0.01)
    return noise, rooms(noise)


def test_noise_is_fitted_to_scans(measured):
    noise, ranges = measured
    found = recorded.fit_noise(LidarConfig(), ANGLES, ranges)
    assert found.range_noise == pytest.approx(noise.range_noise, abs=0.0005)
    assert found.range_noise_growth == pytest.approx(noise.range_noise_growth, abs=0.0002)
    assert 0.1 < found.mixed_pixels < 0.145  # an upper bound, see docs/robot.md
    assert found.dropout == pytest.approx(noise.dropout, abs=0.001)
    assert replace(noise, range_noise=0.01) == replace(
        found, range_noise=0.01, range_noise_growth=0.001, mixed_pixels=0.1, dropout=0.01
    )
    # Some drivers write 0 for no return.
    assert recorded.fit_noise(LidarConfig(), ANGLES, np.where(np.isinf(ranges), 0, ranges)) == found


def test_noise_is_fitted_without_bias():
    # Two walls, 2 and 3 m ahead, and one edge between them, at which 30 % of the beams are mixed.
    rng = np.random.default_rng(0)
    angles = ANGLES[90:271]
    depth = np.where(np.arange(181) < 90, 2.0, 3.0) / np.cos(angles)
    ranges = np.repeat(depth[None], 6000, axis=0)
    is_mixed = rng.uniform(size=6000) < 0.3
    ranges[is_mixed, 90] = rng.uniform(2.0, 3.0, is_mixed.sum())
    ranges += 0.01 * rng.normal(size=ranges.shape)
    found = recorded.fit_noise(LidarConfig(), angles, ranges)
    at_wall = found.range_noise + 2.5 * found.range_noise_growth
    assert at_wall == pytest.approx(0.01, rel=0.01)
    assert found.mixed_pixels == pytest.approx(0.3, abs=0.025)
    assert found.dropout == 0.0


def test_residuals_are_those_of_straight_walls():
    # The wall x = 2 m, of which residuals are as small as float32 allows, and what is no wall.
    wall = 2 / np.cos(ANGLES[90:271])
    residuals, distances = noises._wall_residuals(ANGLES[90:271], wall[None])
    assert residuals.shape == (12, 15)  # 181 beams
    np.testing.assert_allclose(residuals, 0.0, atol=1e-5)
    np.testing.assert_allclose(distances[0], wall[:15].mean(), rtol=1e-6)
    edge = np.where(np.arange(15) < 7, wall[:15], wall[:15] + 1)
    for other in (edge, np.full(15, np.inf), 1 / np.cos(np.linspace(1.2, 1.4, 15))):
        with np.errstate(all="ignore"):
            found, _ = noises._wall_residuals(ANGLES[90:105], other[None])
        assert len(found) == 0


def test_a_scan_narrower_than_a_piece_of_wall_is_refused():
    with pytest.raises(ValueError, match="number of angles = 14: must be at least 15"):
        recorded.fit_noise(LidarConfig(), ANGLES[:14], np.ones((1, 14)))


def test_too_few_scans_to_fit_the_noise_to_are_named():
    expected = "scans show 0 pieces of walls, 20 or more of them in 0 bins of half a metre: must be"
    with pytest.raises(ValueError, match=expected):
        recorded.fit_noise(LidarConfig(), ANGLES, np.full((3, 361), np.inf, np.float32))
    # A round room has all of its walls at one distance.
    expected = "pieces of walls, 20 or more of them in 1 bins"
    with pytest.raises(ValueError, match=expected):
        recorded.fit_noise(LidarConfig(), ANGLES, np.full((3, 361), 2.2, np.float32))
