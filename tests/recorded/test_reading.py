"""Recordings of real sensors, read and checked against a run, and the noise of a LiDAR in them."""

import zipfile
from dataclasses import replace

import numpy as np
import pytest

from jaxsense import recorded, sim
from jaxsense.config import PRESETS, LidarConfig
from jaxsense.recorded import scans as noises

CONFIG = replace(PRESETS["smoke"], arena=replace(PRESETS["smoke"].arena, side=4.0))
LIDAR = sim.make_world(CONFIG).sensors[1]
PLACES = np.array([[1.0, 0.0], [0.0, 0.8], [-0.5, 0.0]])
POSES = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.2], [0.0, 0.0, -3.0]])
EMPTY = np.full((3, 683), 5.0)
HALF_CIRCLE = np.radians(np.linspace(-90, 90, 361))
AHEAD = HALF_CIRCLE[90:271].astype(np.float32)


@pytest.fixture
def write(tmp_path):
    """Writes a recording of the LiDAR, some of whose arrays are changed, or missing if None."""

    def write(**changes):
        found = {"places": PLACES, "lidar_poses": POSES, "lidar_scans": EMPTY, **changes}
        path = tmp_path / "recorded.npz"
        np.savez(path, **{name: values for name, values in found.items() if values is not None})
        return path

    return write


def test_bearing_and_distance_follow_from_poses(write):
    looks = recorded.read(CONFIG, write())
    bearing, distance = looks.seen_from("lidar")
    # Straight ahead; at 90 degrees from a robot at 1.2 rad; behind, 180 degrees from -3 rad.
    np.testing.assert_allclose(bearing, [0.0, np.pi / 2 - 1.2, 3.0 - np.pi], atol=1e-6)
    np.testing.assert_allclose(distance, [1.0, 0.8, 0.5], rtol=1e-6)


def test_a_sensor_may_be_missing_and_have_other_rays(write):
    looks = recorded.read(CONFIG, write())
    assert [*looks.scans] == [*looks.poses] == ["lidar"]
    np.testing.assert_array_equal(looks.scans["lidar"], EMPTY)
    scans = np.stack([np.full(361, 3.0), 2 + HALF_CIRCLE, np.full(361, np.inf)])
    path = write(lidar_scans=scans, lidar_angles=HALF_CIRCLE)
    found = recorded.read(CONFIG, path).scans["lidar"]
    assert found.shape == (3, 683)
    is_seen = np.abs(LIDAR.angles) <= np.pi / 2
    assert np.isnan(found[:, np.abs(LIDAR.angles) > np.radians(90.3)]).all()
    np.testing.assert_allclose(found[0, is_seen], 3.0)
    np.testing.assert_allclose(found[1, is_seen], 2 + LIDAR.angles[is_seen], atol=1e-5)
    assert np.isinf(found[2, is_seen]).all()


def test_a_distance_of_0_is_no_return(write):
    """As an infinite one, along the run's rays and along others."""
    for angles in (None, HALF_CIRCLE):
        scans = np.full((3, 683 if angles is None else 361), 1.0)
        scans[:, np.arange(scans.shape[1]) % 14 > 6] = np.inf  # wider gaps than are closed
        zeros = np.where(np.isinf(scans), 0.0, scans)
        windows = []
        for values in (scans, zeros):
            looks = recorded.read(CONFIG, write(lidar_scans=values, lidar_angles=angles))
            found = np.nan_to_num(looks.scans["lidar"], nan=1.0, posinf=np.inf)
            windows.append(np.stack([sim.cut_out(LIDAR, scan, 0.0) for scan in found]))
        np.testing.assert_array_equal(*windows)
        np.testing.assert_allclose(np.unique(windows[1]), [1.0, float(LIDAR.window_limit)])


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"lidar_scans": EMPTY - 6.0}, r"^lidar_scans holds -1; must be at least 0, infinite or"),
        ({"lidar_poses": None, "lidar_scans": None}, "camera_poses is missing; a recording holds"),
        ({"camera_poses": POSES}, "camera_scans is missing"),
        ({"radar_scans": EMPTY}, "^radar_scans is of an unknown sensor; must be camera or lidar$"),
        (
            {"camera_poses": POSES, "camera_scans": np.full((3, 640, 3), 200, np.uint8)},
            r"^camera_scans holds whole numbers \(uint8\); must be linear RGB from 0 to 1",
        ),
        (
            {"lidar_angles": np.degrees(LIDAR.angles)},
            r"angles of lidar = .*: must be .* \(in radians\?\)",
        ),
        ({"lidar_poses": None}, "lidar_poses is missing"),
        ({"places": None}, "places is missing; a recording holds places, NAME_poses"),
        ({"places": np.zeros((2, 2))}, r"lidar_poses has the shape \(3, 3\); must be \(2, 3\)$"),
        (
            {"lidar_scans": np.zeros((3, 361))},
            r"lidar_scans has the shape \(3, 361\); must be \(3, 683\); "
            "of other rays, lidar_angles must hold the angles, in radians$",
        ),
        ({"lidar_angles": np.zeros((3, 2))}, r"lidar_angles has the shape \(3, 2\); must be"),
        (
            {"lidar_angles": HALF_CIRCLE},
            r"lidar_scans has the shape \(3, 683\); must be \(3, 361\)$",
        ),
        (
            {"lidar_angles": HALF_CIRCLE[:60], "lidar_scans": EMPTY[:, :60]},
            "85 neighbouring rays of lidar were recorded: must be at least 128, the window",
        ),
        (
            {"lidar_angles": HALF_CIRCLE[::5], "lidar_scans": EMPTY[:, :73]},
            "2 neighbouring rays of lidar .* from rays at most 1.06 degrees apart",
        ),
    ],
)
def test_a_recording_that_does_not_fit_is_named_with_what_would(write, changes, reason):
    with pytest.raises(ValueError, match=reason):
        recorded.read(CONFIG, write(**changes))


@pytest.mark.parametrize(
    "content", [b"PK\x03\x04 half of a file", b"", b"(" * 300, "encrypted", "one"]
)
def test_a_broken_file_is_named(tmp_path, content):
    path = tmp_path / "recorded.npz"
    if content == "one":
        path = tmp_path / "one.npy"
        np.save(path, EMPTY)
    elif content == "encrypted":  # zipfile raises RuntimeError
        np.savez(path, places=EMPTY)
        archive = bytearray(path.read_bytes())
        archive[6] = archive[archive.index(b"PK\x01\x02") + 8] = 1
        path.write_bytes(archive)
    elif content.startswith(b"("):  # a header without its end: tokenize.TokenError, or another
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("places.npy", b"\x93NUMPY\x01\x00\xc8\x00" + content)
    else:
        path.write_bytes(content)
    with pytest.raises(ValueError, match="is not a whole file of NumPy's format"):
        recorded.read(CONFIG, path)


def test_noise_is_fitted_without_bias():
    # Two walls, 2 and 3 m ahead, and one edge between them, at which 30 % of the beams are mixed.
    rng = np.random.default_rng(0)
    depth = np.where(np.arange(181) < 90, 2.0, 3.0) / np.cos(AHEAD)
    ranges = np.repeat(depth[None], 12_000, axis=0)
    is_mixed = rng.uniform(size=12_000) < 0.3
    ranges[is_mixed, 90] = rng.uniform(2.0, 3.0, is_mixed.sum())
    ranges += (0.006 + 0.002 * ranges) * rng.normal(size=ranges.shape)
    ranges[rng.uniform(size=ranges.shape) < 0.01] = np.inf
    given = LidarConfig(dropout=0.5, max_range=4.5)
    found = recorded.fit_noise(given, AHEAD, ranges)
    # At 2.5 m.
    assert found.range_noise + 2.5 * found.range_noise_growth == pytest.approx(0.011, rel=0.01)
    assert found.range_noise_growth == pytest.approx(0.002, abs=0.0003)
    assert found.mixed_pixels == pytest.approx(0.3, abs=0.025)
    assert found.dropout == pytest.approx(0.01, abs=0.0005)
    assert found.max_range == given.max_range
    # What is beyond its range counts for nothing: more noise, an edge that is always mixed, gaps.
    far = (3.0 * depth + 0.02 * rng.normal(size=(3000, 181)))[:, ::-1]
    far[:, 90] = rng.uniform(6.5, 8.5, 3000)
    far[rng.uniform(size=far.shape) < 0.1] = np.inf
    assert recorded.fit_noise(given, AHEAD, np.concatenate([ranges, far])) == found
    # Some drivers write 0 for no return.
    assert recorded.fit_noise(given, AHEAD, np.where(np.isinf(ranges), 0, ranges)) == found


def test_residuals_are_those_of_straight_walls():
    # The wall x = 2 m, of which residuals are as small as float32 allows, and what is no wall.
    wall = 2 / np.cos(AHEAD)
    residuals, distances = noises._wall_residuals(AHEAD, wall[None])
    assert residuals.shape == (12, 15)  # 181 beams
    np.testing.assert_allclose(residuals, 0.0, atol=1e-5)
    np.testing.assert_allclose(distances[0], wall[:15].mean(), rtol=1e-6)
    edge = np.where(np.arange(15) < 7, wall[:15], wall[:15] + 1)
    for other in (edge, np.full(15, np.inf), 1 / np.cos(np.linspace(1.2, 1.4, 15))):
        with np.errstate(all="ignore"):
            found, _ = noises._wall_residuals(AHEAD[:15], other[None])
        assert len(found) == 0
