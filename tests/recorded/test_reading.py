"""Recordings of real sensors, read and checked against a run."""

import zipfile
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from jaxsense import recorded, sim
from jaxsense.config import PRESETS
from jaxsense.sim import viewpoints

CONFIG = replace(PRESETS["smoke"], arena=replace(PRESETS["smoke"].arena, side=4.0))
LIDAR = sim.make_world(CONFIG).sensors[1]
PLACES = np.array([[1.0, 0.0], [0.0, 0.8], [-0.5, 0.0]])
POSES = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.2], [0.0, 0.0, -3.0]])
EMPTY = np.full((3, 683), 5.0)
HALF_CIRCLE = np.radians(np.linspace(-90, 90, 361))


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
    expected = [
        viewpoints.bearing(jnp.array(p), jnp.array(q)) for p, q in zip(POSES, PLACES, strict=True)
    ]
    np.testing.assert_allclose(bearing, expected, atol=1e-6)


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
