"""The noise of a LiDAR, fitted to scans."""

import numpy as np
import pytest

from jaxsense import recorded
from jaxsense.config import LidarConfig
from jaxsense.recorded import scans as noises

ANGLES = np.radians(np.linspace(-90, 90, 361)).astype(np.float32)


def test_noise_is_fitted_without_bias():
    # Two walls, 2 and 3 m ahead, and one edge between them, at which 30 % of the beams are mixed.
    rng = np.random.default_rng(0)
    angles = ANGLES[90:271]
    depth = np.where(np.arange(181) < 90, 2.0, 3.0) / np.cos(angles)
    ranges = np.repeat(depth[None], 12_000, axis=0)
    is_mixed = rng.uniform(size=12_000) < 0.3
    ranges[is_mixed, 90] = rng.uniform(2.0, 3.0, is_mixed.sum())
    ranges += (0.006 + 0.002 * ranges) * rng.normal(size=ranges.shape)
    ranges[rng.uniform(size=ranges.shape) < 0.01] = np.inf
    given = LidarConfig(dropout=0.5, max_range=4.5)
    found = recorded.fit_noise(given, angles, ranges)
    # At 2.5 m.
    assert found.range_noise + 2.5 * found.range_noise_growth == pytest.approx(0.011, rel=0.01)
    assert found.range_noise_growth == pytest.approx(0.002, abs=0.0003)
    assert found.mixed_pixels == pytest.approx(0.3, abs=0.025)
    assert found.dropout == pytest.approx(0.01, abs=0.0005)
    assert found.max_range == given.max_range
    # Some drivers write 0 for no return.
    assert recorded.fit_noise(given, angles, np.where(np.isinf(ranges), 0, ranges)) == found


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
