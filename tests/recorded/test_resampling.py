"""Recorded scans along other rays."""

import numpy as np
import pytest

from jaxsense.config import CameraConfig, LidarConfig
from jaxsense.recorded import resampling
from jaxsense.recorded.scans import resample
from jaxsense.sim import sensors

LIDAR = sensors.lidar(LidarConfig(num_beams=9, field_of_view=80.0, window=3))  # every 10 degrees
CAMERA = sensors.camera(CameraConfig(num_pixels=8, window=3, stride=1))


def degrees(*values):
    return np.radians(np.array(values, float))


def read(angles, ranges):
    return resampling.resample(LIDAR.angles, angles, ranges, measures_distance=True)


@pytest.mark.parametrize(
    ("function", "angles", "ranges", "expected"),
    [
        (read, [0, 0.1], [1, 1, 1], r"readings have the shape \(3,\): must be one for each of 2"),
        (read, [0], [1], "angles of 1 rays: must be of two or more"),
        (read, [0, np.nan], [1, 1], r"angles = nan: must be from -2 pi to 2 pi \(in radians\?\)"),
        (read, [-180, 180], [1, 1], "angles = -180: must be from -2 pi to 2 pi"),
        (resampling.close_gaps, [0, 90], [1, 1], "angles = 90: must be from"),
        (resampling.close_gaps, [0, 1], [1, 1, 1], "one for each of 2"),
    ],
)
def test_a_scan_along_no_directions_is_refused(function, angles, ranges, expected):
    with pytest.raises(ValueError, match=expected):
        function(np.float64(angles), np.float64(ranges))
    read(np.array([-2 * np.pi, 0, 2 * np.pi]), np.ones(3))


def test_distances_are_interpolated_on_a_surface_and_nearest_at_an_edge():
    angles = degrees(-35, -25, -15, -5, 5, 15, 25, 35)
    #                     surface          edge      no return
    readings = np.array([[1.0, 1.08, 1.04, 3.0, 3.02, 0.0, np.inf, 2.0]])
    found = resample(LIDAR, angles + degrees(1)[0], readings)[0]
    # The ray at -40 is 6 degrees beyond the first, more than half a step; that at 40 is 4 beyond.
    np.testing.assert_array_equal(np.isnan(found), [True, *[False] * 8])
    # At -30, 4 of 10 degrees after the ray at -34; at -10, 4 degrees after 1.04, before an edge.
    # At -20: 1.08 + .4 (1.04 - 1.08); at 0: 3 + .4 * .02; at 20 and 30 the nearest.
    expected = [1.032, 1.064, 1.04, 3.008, 3.02, np.inf, np.inf]
    np.testing.assert_allclose(found[1:], [*expected, 2.0], rtol=1e-5)


# A whole turn every 10 degrees, from -180 to 180; those at both ends look in one direction.
AROUND = sensors.lidar(LidarConfig(num_beams=37, field_of_view=360.0, window=3))


def test_a_full_circle_is_closed():
    angles = degrees(*range(-175, 180, 10))
    readings = np.full((1, 36), 2.0)
    #              -175, -165  165,  175
    readings[0, [0, 1, 34, 35]] = 1.0, 1.02, 1.1, 1.06
    found = resample(AROUND, angles, readings)[0]
    # At -180 and at 180, half way from the ray at 175 to that at -175.
    np.testing.assert_allclose(found[[0, 1, 35, 36]], [1.03, 1.01, 1.08, 1.03], rtol=1e-5)
    assert np.isfinite(found).all()
    # From 0 on, as some drivers count, and with a ray at both ends.
    turned = resample(AROUND, angles % (2 * np.pi), readings)[0]
    np.testing.assert_allclose(turned, found, rtol=1e-6)
    twice = 1 + np.arange(37.0)[None]
    twice[0, -1] = 1.0
    np.testing.assert_allclose(resample(AROUND, AROUND.angles, twice)[0], twice[0], atol=1e-4)


def test_pixels_are_interpolated_for_each_channel():
    angles = np.linspace(0.8, -0.8, 60)
    colour = np.stack([angles, angles**2, np.zeros(60)], axis=-1)[None]
    found = resample(CAMERA, angles, colour)[0]
    expected = np.stack([CAMERA.angles, CAMERA.angles**2, np.zeros(8)], axis=-1)
    np.testing.assert_allclose(found, expected, atol=2e-3)


@pytest.mark.parametrize(
    ("angles", "reason"),
    [
        (degrees(-40, 0, 40), "1 neighbouring rays .* at least 3, .* at most 30.00 degrees apart"),
        (degrees(0), "1 neighbouring rays"),
        (degrees(0, 5, 10), "2 neighbouring rays of lidar were recorded: must be at least 3, the"),
        (degrees(*range(150, 211, 10)), "0 neighbouring rays of lidar were recorded: must"),
    ],
)
def test_scans_that_do_not_suffice_are_refused_with_what_would_fit(angles, reason):
    with pytest.raises(ValueError, match=reason):
        resample(LIDAR, angles, np.ones((1, len(angles))))


def wall(angles):
    """A wall 2 m ahead, as seen along rays."""
    return 2 / np.cos(angles)


def merged(angles, between):
    """Three sweeps a little apart."""
    return np.concatenate([angles + i * between for i in range(3)])


AHEAD = np.radians(np.arange(-30, 31))
UNEVEN = np.radians(np.concatenate([np.arange(-30, 0, 0.1), np.arange(0, 31, 0.5)]))


@pytest.mark.parametrize(
    "angles",
    [
        AHEAD,
        merged(AHEAD, 1e-7),
        merged(AHEAD, 1e-3),
        UNEVEN,
        np.radians(np.arange(-30, 31, 0.1)),
        np.radians(np.arange(-30, 31, 3.0)),
    ],
    ids=["even", "merged", "interlaced", "uneven", "fine", "coarse"],
)
def test_scans_along_any_rays_are_read_where_they_were_recorded(angles):
    rng = np.random.default_rng(0)
    order = rng.permutation(len(angles))
    targets = np.radians(np.arange(-29, 30))
    found = resampling.resample(targets, angles[order], wall(angles)[order], measures_distance=True)
    # Between rays .0524 rad apart, a straight line is off by at most r'' / 8 of the squared angle:
    # at 30 degrees 2 (1 + 2 tan^2) / cos / 8 * .0524^2 = .0013 m.
    np.testing.assert_allclose(found, wall(targets), atol=0.0014)
    # A lost beam of one sweep, or of an uneven scan, is closed.
    lost = wall(angles)
    lost[len(angles) // 2] = np.inf
    step = resampling.median_step(targets)
    closed = resampling.close_gaps(angles[order], lost[order], step=step)
    np.testing.assert_allclose(closed, wall(angles)[order], atol=0.08)


def test_a_gap_wider_than_three_steps_of_the_rays_that_are_read_was_not_recorded():
    targets = np.radians(np.arange(-10.0, 11.0))
    # Merged sweeps of every 3 degrees were recorded, of every 4 degrees only near their rays.
    for between, share in ((3.0, 1.0), (4.0, 5 / 21)):
        angles = merged(np.radians(np.arange(-12.0, 13.0, between)), 1e-7)
        found = resampling.resample(targets, angles, wall(angles), measures_distance=True)
        assert np.isfinite(found).mean() == pytest.approx(share)
        np.testing.assert_array_equal(np.isfinite(found), resampling.covered(targets, angles))
    # As far apart as is needed.
    assert resampling.covered(targets, angles, step=np.radians(2.0)).all()
    # One ray has no step: that of the recorded ones counts.
    assert resampling.covered(np.zeros(1), np.radians([-5.0, 5.0, 15.0])).all()
    # Two have one, .2 of what is between those that were recorded.
    assert not resampling.covered(np.radians([0.0, 2.0]), np.radians([-5.0, 5.0])).any()
    assert not resampling.covered(np.zeros(1), np.radians([100.0, 101.0, 102.0])).any()


def test_short_gaps_between_beams_are_closed():
    inf, nan = np.inf, np.nan
    # One lost beam; three in a row, of which the middle one is as near to either side; 0 and NaN
    # are no returns.
    ranges = [1.0, inf, 2.0, 0.0, nan, inf, 3.0]
    np.testing.assert_array_equal(close_gaps(ranges), np.float32([1, 1, 2, 2, 2, 3, 3]))
    # Ends, what is too near, and longer gaps stay.
    for same in ([inf, 1.0, 1.0], [1.0, 1.0, inf], [1.0, -inf, 1.0], [inf] * 3, [1.0]):
        np.testing.assert_array_equal(close_gaps(same), np.float32(same))
    for lost, is_closed in ((5, True), (6, False)):
        scan = np.array([1.0, *[inf] * lost, 4.0])
        found = close_gaps(scan)
        assert np.isfinite(found).all() == is_closed
        assert found.dtype == np.float32
    np.testing.assert_array_equal(found, np.float32(scan))


def close_gaps(ranges):
    """Closes gaps between beams of ten degrees."""
    return resampling.close_gaps(np.radians(10.0 * np.arange(len(ranges))), ranges)


@pytest.mark.parametrize(("first", "turn"), [(0, 1), (-180, 1), (10, 1), (0, -1), (180, -1)])
def test_gaps_are_closed_across_the_ends_of_a_full_circle(first, turn):
    # Every ten degrees, from any direction on; three in a row are lost around 0 degrees.
    angles = np.radians(first + turn * 10.0 * np.arange(36))
    ahead = np.round(np.degrees(resampling.within_a_turn(angles)))
    ranges = np.where(ahead < 0, 1.0, 2.0)
    lost = np.where(np.abs(ahead) <= 10, np.inf, ranges)
    found = resampling.close_gaps(angles, lost)
    expected = np.where(ahead == 0, found[ahead == 0], np.where(ahead < 0, 1.0, 2.0))
    np.testing.assert_array_equal(found, expected)
    assert found[ahead == 0] in (1, 2)
    # Half a circle has no neighbours beyond its ends.
    half = np.abs(ahead - 90) < 91
    np.testing.assert_array_equal(
        resampling.close_gaps(angles[half], lost[half])[ahead[half] == 0], np.inf
    )


def test_no_gap_is_closed_across_what_was_not_recorded():
    inf = np.inf
    # Half a circle whose last beam, which is lost, lies where a turn ends.
    half = np.linspace(0, np.pi, 181)
    ranges = np.where(half > 3.1, inf, 3.0)
    ranges[0] = 1.0
    np.testing.assert_array_equal(resampling.close_gaps(half, ranges), np.float32(ranges))
    # Three quarters of one, across the robot's back, whose first beams are lost.
    across = np.radians(np.arange(-45.0, 226.0))
    ranges = np.where(np.arange(271) < 3, inf, 4.0)
    np.testing.assert_array_equal(resampling.close_gaps(across, ranges), np.float32(ranges))
    ranges[[134, 135, 136]] = inf  # while gaps at the robot's back are closed
    found = resampling.close_gaps(across, ranges)
    np.testing.assert_array_equal(found, np.where(np.arange(271) < 3, inf, np.float32(4.0)))
    # A sector in the middle that was not recorded, next to lost beams.
    gapped = np.radians([*range(60), *range(150, 210)])
    ranges = np.where(np.abs(np.arange(120) - 59.5) < 2, inf, 2.0)
    np.testing.assert_array_equal(resampling.close_gaps(gapped, ranges), np.float32(ranges))
    # Something too near is no distance to fill a gap with.
    np.testing.assert_array_equal(close_gaps([1.0, -inf, inf, 2.0, 2.0])[1:3], [-inf, inf])
