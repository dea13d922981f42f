"""Recordings of real sensors: read, checked against a run, and compared with simulated looks."""

import zipfile
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from smoke import save_models

import jaxsense
from jaxsense import sim
from jaxsense.config import PRESETS
from jaxsense.run import recordings
from jaxsense.run.rundir import RunDirectory, Settings
from jaxsense.show import scan_plots
from jaxsense.show.pairs import Pairs

CONFIG = replace(PRESETS["smoke"], arena=replace(PRESETS["smoke"].arena, side=4.0))
LIDAR = sim.sensors.make(CONFIG)[1]
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
    looks = recordings.read(CONFIG, write())
    bearing, distance = looks.seen_from("lidar")
    # Straight ahead; at 90 degrees from a robot at 1.2 rad; behind, 180 degrees from -3 rad.
    np.testing.assert_allclose(bearing, [0.0, np.pi / 2 - 1.2, 3.0 - np.pi], atol=1e-6)
    np.testing.assert_allclose(distance, [1.0, 0.8, 0.5], rtol=1e-6)
    expected = [sim.bearing(jnp.array(p), jnp.array(q)) for p, q in zip(POSES, PLACES, strict=True)]
    np.testing.assert_allclose(bearing, expected, atol=1e-6)


def test_the_bytes_of_an_image_are_not_taken_for_brightness(write):
    pixels = np.full((3, *sim.sensors.make(CONFIG)[0].angles.shape, 3), 200, np.uint8)
    path = write(camera_poses=POSES, camera_scans=pixels)
    with pytest.raises(ValueError, match=r"^camera_scans holds whole numbers \(uint8\); must be "):
        recordings.read(CONFIG, path)
    recordings.read(CONFIG, write(camera_poses=POSES, camera_scans=pixels / 255))


def test_a_recording_that_was_compressed_and_damaged_is_named(tmp_path):
    path = tmp_path / "recorded.npz"
    np.savez_compressed(path, places=np.random.default_rng(0).normal(size=(500, 2)))
    content = bytearray(path.read_bytes())
    content[200:400] = bytes(200)
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"is not a whole file of NumPy's format \.npz"):
        recordings.read(CONFIG, path)


@pytest.mark.parametrize("changes", [{}, {"lidar_poses": None, "lidar_scans": None}])
def test_an_unknown_sensor_is_named(write, changes):
    with pytest.raises(ValueError, match=r"^radar_scans is of an unknown sensor; must be camera"):
        recordings.read(CONFIG, write(radar_scans=EMPTY, **changes))


def test_angles_in_degrees_are_refused(write):
    path = write(lidar_angles=np.degrees(LIDAR.angles))
    with pytest.raises(ValueError, match=r"angles of lidar = .*: must be .* \(in radians\?\)"):
        recordings.read(CONFIG, path)


def test_a_sensor_may_be_missing_and_have_other_rays(write):
    looks = recordings.read(CONFIG, write())
    assert [*looks.scans] == [*looks.poses] == ["lidar"]
    np.testing.assert_array_equal(looks.scans["lidar"], EMPTY)
    scans = np.stack([np.full(361, 3.0), 2 + HALF_CIRCLE, np.full(361, np.inf)])
    path = write(lidar_scans=scans, lidar_angles=HALF_CIRCLE)
    found = recordings.read(CONFIG, path).scans["lidar"]
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
            looks = recordings.read(CONFIG, write(lidar_scans=values, lidar_angles=angles))
            found = np.nan_to_num(looks.scans["lidar"], nan=1.0, posinf=np.inf)
            windows.append(np.stack([sim.cut_out(LIDAR, scan, 0.0) for scan in found]))
        np.testing.assert_array_equal(*windows)
        np.testing.assert_allclose(np.unique(windows[1]), [1.0, float(LIDAR.window_limit)])


def test_gaps_of_lost_beams_are_closed_as_on_robots(write):
    for angles in (None, HALF_CIRCLE):
        scans = np.full((3, 683 if angles is None else 361), 1.0)
        whole = recordings.read(CONFIG, write(lidar_scans=scans, lidar_angles=angles))
        for lost in (np.inf, 0.0):
            scans[:, 60:300:40] = lost
            looks = recordings.read(CONFIG, write(lidar_scans=scans, lidar_angles=angles))
            np.testing.assert_array_equal(looks.scans["lidar"], whole.scans["lidar"])
        scans[:, 60:300:40] = np.nan  # not recorded
        looks = recordings.read(CONFIG, write(lidar_scans=scans, lidar_angles=angles))
        new = np.isnan(looks.scans["lidar"]) & ~np.isnan(whole.scans["lidar"])
        assert new.any(axis=1).all()


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        (
            {"lidar_scans": EMPTY - 6.0},
            r"^lidar_scans holds -1; must be at least 0, infinite or 0 without a return$",
        ),
        (
            {"lidar_angles": HALF_CIRCLE, "lidar_scans": EMPTY[:, :361] - 6.5},
            r"^lidar_scans holds -1\.5; must be at least 0, infinite or 0 without a return$",
        ),
        ({"lidar_poses": None, "lidar_scans": None}, "camera_poses is missing; a recording holds"),
        ({"camera_poses": POSES}, "camera_scans is missing"),
        ({"lidar_poses": None}, "lidar_poses is missing"),
        ({"places": None}, "places is missing; a recording holds places, camera_poses"),
        ({"places": np.zeros((2, 2))}, r"lidar_poses has the shape \(3, 3\); must be \(C, 3\) for"),
        (
            {"lidar_scans": np.zeros((3, 361))},
            r"lidar_scans has the shape \(3, 361\); must be \(C, 683\) for C places; "
            "of other rays, lidar_angles must hold the angles, in radians$",
        ),
        (
            {"lidar_angles": np.zeros((3, 2))},
            r"lidar_angles has the shape \(3, 2\); must be \(A,\)",
        ),
        (
            {"lidar_angles": HALF_CIRCLE},
            r"lidar_scans has the shape \(3, 683\); must be \(C, 361\) for C places$",
        ),
        (
            {"lidar_angles": HALF_CIRCLE[:60], "lidar_scans": EMPTY[:, :60]},
            "recorded part of the field of view of lidar = 29.6 degrees: must be at least 44.7",
        ),
        (
            {"lidar_angles": HALF_CIRCLE[::5], "lidar_scans": EMPTY[:, :73]},
            "step between the rays of lidar = 2.50 degrees: must be at most 1.06 degrees",
        ),
    ],
)
def test_a_recording_that_does_not_fit_is_named_with_what_would(write, changes, reason):
    with pytest.raises(ValueError, match=reason):
        recordings.read(CONFIG, write(**changes))


@pytest.mark.parametrize("content", [b"PK\x03\x04 half of a file", b""])
def test_a_broken_file_is_named(tmp_path, content):
    path = tmp_path / "recorded.npz"
    path.write_bytes(content)
    with pytest.raises(ValueError, match="is not a whole file of NumPy's format"):
        recordings.read(CONFIG, path)
    np.save(tmp_path / "one.npy", EMPTY)
    with pytest.raises(ValueError, match="is not a whole file of NumPy's format"):
        recordings.read(CONFIG, tmp_path / "one.npy")


@pytest.mark.parametrize(
    ("place", "byte"),
    [
        (6, 1),  # encrypted: zipfile raises RuntimeError
        (6, 32),  # patched: NotImplementedError
        (8, 97),  # an unknown compression: NotImplementedError
        (None, 200),  # a header without its end: tokenize.TokenError, or another of its own
    ],
)
def test_whatever_an_archive_makes_its_readers_raise_is_one_error(tmp_path, place, byte):
    path = tmp_path / "recorded.npz"
    np.savez(path, places=EMPTY)
    content = bytearray(path.read_bytes())
    central = content.index(b"PK\x01\x02")
    if place is None:
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("places.npy", b"\x93NUMPY\x01\x00" + bytes([byte, 0]) + b"(" * byte)
    else:
        content[place] = content[central + place + 2] = byte
        path.write_bytes(content)
    with pytest.raises(ValueError, match="is not a whole file of NumPy's format"):
        recordings.read(CONFIG, path)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A directory with a run whose networks are not trained."""
    path = tmp_path_factory.mktemp("runs") / "run"
    with RunDirectory.create(path, Settings("smoke", 0, CONFIG)) as created:
        save_models(created, jaxsense.init(jax.random.key(0), CONFIG))
    return path


@pytest.fixture
def few(monkeypatch):
    """Few windows to find the nearest of, for they are simulated one after the other."""
    monkeypatch.setattr(sim.similar, "NUM_SIMULATED", 24)


def simulated(number=8):
    """A simulated recording by both sensors."""
    world, found = sim.make_world(CONFIG), {}

    @jax.jit
    @jax.vmap
    def record(key):
        scene_key, *keys = jax.random.split(key, 3)
        scene = sim.random_scene(scene_key, world, jnp.array([0, 1, 2]))
        found = {"places": scene.layout.position[0]}
        for m, sensor in enumerate(world.sensors):
            look_key, noise_key = jax.random.split(keys[m])
            _, scene = sim.look(look_key, world, scene, m, jnp.int32(0))
            data, rays = sim.place(world.arena, scene.layout, scene.poses), sensor.directions
            found[f"{sensor.name}_scans"] = sim.scan(
                noise_key, sensor, world.arena, data, scene.layout, scene.light, m, jnp.array(rays)
            )
            found[f"{sensor.name}_poses"] = scene.poses[m]
        return found

    found = record(jax.random.split(jax.random.key(1), number))
    return {name: np.array(values) for name, values in found.items()}


@pytest.mark.slow
def test_recorded_windows_are_compared_with_simulated_ones(run, write, few):
    path = write(**simulated())
    found = jaxsense.compare_scans(run, path)
    assert [*found.of_sensors] == ["camera", "lidar"]
    for apart in found.of_sensors.values():
        # A simulated recording is as far from simulated windows as they are from each other.
        assert apart.looks == 8
        assert 0 < apart.recorded < 1.5 * apart.simulated
    # Each beam is off by .01 m, and so is each of the windows that it is compared with.
    assert found.of_sensors["lidar"].recorded == pytest.approx(0.0125, abs=0.003)
    assert found.picture == path.with_name("recorded.npz.svg")
    assert found.residuals == path.with_name("recorded.npz.residuals.svg")
    for picture in (found.picture, found.residuals):
        assert picture.read_bytes().startswith(b"<?xml")
    camera, lidar = str(found).splitlines()
    assert camera.startswith("camera: 8 recorded windows are 0.0")
    assert lidar.startswith(
        f"lidar: 8 recorded windows are {found.of_sensors['lidar'].recorded:.4f}"
    )
    with pytest.raises(FileExistsError, match=r"recorded\.npz\.svg"):
        jaxsense.compare_scans(run, path)
    # One of the two is not written without the other.
    found.picture.unlink()
    with pytest.raises(FileExistsError, match=r"recorded\.npz\.residuals\.svg"):
        jaxsense.compare_scans(run, path)
    assert not found.picture.exists()


@pytest.mark.slow
def test_another_scanner_is_farther_from_simulated_windows(run, write, few, tmp_path):
    content = simulated()
    number = len(content["places"])
    # Too far by .2 m, and the last three looks are behind the robot.
    content["lidar_scans"] = content["lidar_scans"] + 0.2
    content["lidar_poses"][-3:, 2] += np.pi
    content = {name: x for name, x in content.items() if not name.startswith("camera")}
    found = jaxsense.compare_scans(run, write(**content), tmp_path / "picture.png")
    for name in ("picture.png", "picture.residuals.png"):
        assert (tmp_path / name).read_bytes().startswith(b"\x89PNG")
    assert [*found.of_sensors] == ["lidar"]
    assert found.of_sensors["lidar"].looks == number - 3
    assert 0.13 < found.of_sensors["lidar"].recorded < 0.22
    content["lidar_poses"][:-3, 2] += np.pi
    with pytest.raises(ValueError, match="lidar_scans: no window around a PoI was recorded"):
        jaxsense.compare_scans(run, write(**content), tmp_path / "another.svg")
    assert not list(tmp_path.glob("another*"))


def test_residuals_are_drawn_as_they_are():
    """Three of four rays at the PoI, the other one elsewhere."""
    recorded = np.array([[0.01, -0.03, 0.02, np.nan]])
    simulated = np.array([[0.01, 0.01, -0.01, np.nan]])
    window = np.zeros((1, 4))
    pairs = Pairs(LIDAR, window, window, recorded, simulated, np.ones(1))
    histogram, sizes = scan_plots.residuals([pairs]).axes
    legend = histogram.get_legend()
    assert legend is not None
    assert [text.get_text() for text in legend.get_texts()] == [
        "recorded, median +0.0100",
        "simulated, median +0.0100",
    ]
    assert histogram.get_xlabel() == "residual of lidar [m]"
    # All have at least the smallest size, a third of them the largest.
    lines = [np.asarray(line.get_xydata()) for line in sizes.lines]
    np.testing.assert_allclose(lines[0], [[0.01, 1], [0.02, 2 / 3], [0.03, 1 / 3]], rtol=1e-5)
    np.testing.assert_allclose(lines[1], [[0.01, 1], [0.01, 2 / 3], [0.01, 1 / 3]], rtol=1e-5)
