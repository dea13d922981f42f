import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsense import sim
from jaxsense.config import CameraConfig, Config, LidarConfig
from jaxsense.sim import sensors, windows
from jaxsense.sim.light import Light
from jaxsense.sim.raycast import Hit

# Towards +x and up by an elevation whose cosine is 0.8.
LIGHT = Light(jnp.array([0.8, 0.0, 0.6]), diffuse=jnp.float32(0.5), ambient=jnp.float32(0.25))
# Robots 0 and 1 look at the cylinder in the origin from 0.5 m before and behind it.
FACE_TO_FACE = jnp.array([[-0.5, 0.0, 0.0], [0.5, 0.0, np.pi]])
GREEN = np.array([0.1, 0.7, 0.1])
RED = np.array([0.8, 0.1, 0.1])
WALL = np.array([0.6, 0.6, 0.6])
BLACK = {"colour": jnp.zeros((1, 3))}
WHITE = {"colour": jnp.ones((1, 3))}


def hits_at(distance):
    distance = jnp.asarray(distance, jnp.float32)
    return Hit(distance, jnp.where(distance < jnp.inf, 0, -1), (0 * distance, 0 * distance))


@pytest.fixture(scope="module")
def noiseless():
    return sensors.make(
        Config(camera=CameraConfig(pixel_noise=0.0), lidar=LidarConfig(range_noise=0.0))
    )


@pytest.fixture(scope="module")
def scan(arena, noiseless):
    """Full noiseless scans of robot 0's camera and robot 1's LiDAR."""

    def scan(layout, poses):
        data = sim.place(arena, layout, poses)
        key = jax.random.key(0)
        return tuple(
            sim.scan(key, sensor, arena, data, layout, LIGHT, robot, jnp.array(sensor.directions))
            for robot, sensor in enumerate(noiseless)
        )

    return scan


@pytest.fixture(scope="module")
def scans(scan):
    jitted = jax.jit(scan)
    return lambda *args: jax.device_get(jitted(*args))


@pytest.fixture(scope="module")
def view(scans, known_layout):
    return scans(known_layout, FACE_TO_FACE)


def test_a_single_ray_points_ahead():
    one = sensors.lidar(LidarConfig(num_beams=1, window=1))
    np.testing.assert_array_equal(one.angles, [0.0])
    assert one.rays.centre(jnp.float32(0.0)) == 0.0
    assert one.steps == (0.0, 0.0)


def test_camera_rays_are_those_of_a_pinhole_from_left_to_right():
    angles = sensors.camera(CameraConfig()).angles
    assert angles.shape == (640,)
    assert np.all(np.diff(angles) < 0)
    np.testing.assert_allclose(angles, -angles[::-1], atol=1e-6)
    # The edges of 640 pixels are at +-40 degrees, so the first one's middle is 319.5 of 320 there.
    assert np.tan(angles[0]) == pytest.approx(np.tan(np.radians(40)) * 319.5 / 320, rel=1e-5)
    # On a pinhole's plane the pixels are equally far apart.
    np.testing.assert_allclose(
        np.diff(np.tan(angles)), -2 * np.tan(np.radians(40)) / 640, rtol=1e-2
    )


@pytest.mark.parametrize("name", ["camera", "lidar"])
@pytest.mark.parametrize("bearing", [-0.4, -0.11, 0.0, 0.25])
def test_centre_is_the_ray_along_a_bearing(noiseless, name, bearing):
    sensor = {s.name: s for s in noiseless}[name]
    index = np.interp(
        bearing, *zip(*sorted(zip(sensor.angles, range(9999), strict=False)), strict=True)
    )
    assert float(sensor.rays.centre(jnp.float32(bearing))) == pytest.approx(index, abs=0.02)


def test_noise_of_pixels_has_the_configured_standard_deviation():
    camera = sensors.camera(CameraConfig(pixel_noise=0.05))
    many = hits_at(jnp.full(20_000, 2.0))
    pixels = np.array(camera.read(jax.random.key(1), many, WHITE, LIGHT))
    # The normal is zero, so all light is ambient: 0.25, five deviations from being clipped.
    np.testing.assert_allclose(pixels.std(axis=0), 0.05, atol=1e-3)
    np.testing.assert_allclose(pixels.mean(axis=0), 0.25, atol=1.5e-3)
    np.testing.assert_allclose(np.corrcoef(pixels.T), np.eye(3), atol=0.03)
    # Within full scale, whatever the noise.
    noisy = sensors.camera(CameraConfig(pixel_noise=0.5))
    pixels = np.array(noisy.read(jax.random.key(1), many, WHITE, LIGHT))
    assert (pixels.min(), pixels.max()) == (0.0, 1.0)


def test_ranges_stop_at_the_shortest_and_the_longest():
    exact = sensors.lidar(LidarConfig(range_noise=0.0))
    distances = [0.02, 0.08, 1.0, 4.99, 5.01, 7.0, jnp.inf]
    ranges = exact.read(jax.random.key(0), hits_at(distances), BLACK, LIGHT)
    np.testing.assert_allclose(ranges, [0.08, 0.08, 1.0, 4.99, 5.0, 5.0, 5.0], rtol=1e-6)


def test_hand_worked_colours_of_a_lambert_surface(view, scans, known_layout, noiseless):
    pixels, _ = view
    # The cylinder's near side faces -x, away from the light: ambient alone, 0.25 of green.
    np.testing.assert_allclose(pixels[[319, 320]], np.tile(0.25 * GREEN, (2, 1)), atol=1e-6)
    # From the other side its normal is +x: 0.25 + 0.5 * 0.8 = 0.65 of green. The pixel beside
    # the middle meets it at a normal that is turned by less than 0.01 rad, of cosine 1.
    turned, _ = scans(known_layout, jnp.array([[0.5, 0.0, np.pi], [-1.0, 0.0, 0.0]]))
    np.testing.assert_allclose(turned[[319, 320]], np.tile(0.65 * GREEN, (2, 1)), atol=1e-4)
    # A wall at x = 1.5 faces -x: 0.25 of 0.6. The one at x = -1.5 faces +x: 0.65 of 0.6.
    dark, _ = scans(known_layout, jnp.array([[1.0, 0.2, 0.0], [-1.0, 0.0, 0.0]]))
    lit, _ = scans(known_layout, jnp.array([[-1.0, 0.2, np.pi], [-0.5, -0.5, 0.0]]))
    np.testing.assert_allclose(dark[320], 0.15 * WALL / 0.6, atol=1e-6)
    np.testing.assert_allclose(lit[320], 0.39 * WALL / 0.6, atol=1e-6)
    # The cube at (0, 1) is turned by 30 degrees: from +x one sees the side whose normal is
    # (cos 30, sin 30): 0.25 + 0.5 * 0.8 * 0.866025 = 0.596410 of red.
    cube, _ = scans(known_layout, jnp.array([[0.5, 1.0, np.pi], [-1.0, 0.0, 0.0]]))
    np.testing.assert_allclose(cube[320], 0.596410 * RED, atol=1e-5)


def test_lidar_ranges_in_a_known_scene(view):
    _, ranges = view
    # Straight ahead 0.5 - 0.1 m to the cylinder; to the left, 90 degrees is 90 / (240 / 682) =
    # 255.75 beams from the middle beam 341, at 89.74 degrees it is 1.5 m / cos 0.26 to the wall.
    assert ranges[341] == pytest.approx(0.4, abs=1e-5)
    assert ranges[341 + 255] == pytest.approx(1.5, abs=1e-4)
    assert ranges[341 - 255] == pytest.approx(1.5, abs=1e-4)
    # The cylinder covers asin(0.1 / 0.5) = 11.54 degrees to either side: 32.8 beams.
    np.testing.assert_array_equal(np.flatnonzero(ranges[220:463] < 0.6) + 220, range(309, 374))


def indices(sensor, bearing):
    """Of the rays of a window."""
    return np.asarray(windows.around(sensor, np.arange(len(sensor.angles)), bearing), int)


def test_windows_stop_at_the_edges(noiseless):
    camera, lidar = noiseless
    # Far left is the camera's first pixel and the LiDAR's last beam. 80 pixels, every 4th, span
    # 79 * 4 = 316; 128 beams span 127.
    cases = (camera, 0.69, 0), (camera, -0.69, 639 - 316), (lidar, 2.0, 682 - 127), (lidar, -2.0, 0)
    for sensor, bearing, first in cases:
        expected = first + sensor.stride * np.arange(sensor.window)
        np.testing.assert_array_equal(indices(sensor, bearing), expected)


def test_detector_input_is_flat_and_cut_off(noiseless):
    camera, lidar = noiseless
    ranges = jnp.linspace(0.01, 3.0, 128)  # 0 is no return
    np.testing.assert_allclose(windows.as_window(lidar, ranges), np.minimum(ranges, 1.5))
    assert windows.as_window(camera, jnp.zeros((80, 3))).shape == (240,)


def test_a_robot_does_not_see_itself_but_sees_the_other(scans, known_layout):
    # Robot 0's camera looks at robot 1, 0.4 m ahead; robot 1's LiDAR looks over robot 0, which
    # has no tower, at the wall 1 m behind it.
    pixels, ranges = scans(known_layout, jnp.array([[-0.5, -0.5, np.pi], [-0.9, -0.5, 0.0]]))
    # Its body's colour is (0.25, 0.25, 0.3), and it faces +x: 0.65 of that.
    np.testing.assert_allclose(pixels[320], 0.65 * np.array([0.25, 0.25, 0.3]), atol=1e-4)
    assert ranges[341] == pytest.approx(1.5 + 0.9, abs=1e-4)
