"""Windows that a misplaced robot tries, and the looks that a detector has learned from."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsense import PRESETS
from jaxsense.config.mission import LocalisationConfig, Search
from jaxsense.sim import sensors, windows

CONFIG = PRESETS["default"]
CAMERA, LIDAR = sensors.make(CONFIG)
BOTH = pytest.mark.parametrize("sensor", [CAMERA, LIDAR], ids=["camera", "lidar"])


def test_a_search_reads_as_many_more_rays_as_its_errors_need():
    # The LiDAR's rays are 240 / 682 = .3519 degrees apart, and 6 / .3519 = 17.05. Every fourth of
    # the camera's is read, 4 x 80 / 639 = .5008 apart, and 6 / .5008 = 11.98.
    heading = Search(heading=6.0)
    assert windows.widened(LIDAR, heading).window == LIDAR.window + 2 * 18
    assert windows.widened(CAMERA, heading).window == CAMERA.window + 2 * 12
    # .15 m across .3 m are half a radian or 28.65 degrees, and 28.65 / .3519 = 81.41.
    position = Search(position=0.15)
    assert windows.widened(LIDAR, position).window == LIDAR.window + 2 * 82
    # The larger of two errors counts more: (6^2 + 28.65^2)^.5 = 29.27, and / .3519 = 83.2.
    both = Search(position=0.15, heading=6.0)
    assert windows.widened(LIDAR, both).window == LIDAR.window + 2 * 84
    # The camera has 640 rays, of which 160 are read.
    wide = Search(position=0.3, heading=30.0)
    assert windows.widened(CAMERA, wide).window == 160


@functools.cache
def searching(name, errors):
    """Windows, distances and their prior, from a whole scan, a bearing and a distance."""
    sensor = {"camera": CAMERA, "lidar": LIDAR}[name]

    @jax.jit
    def candidates(scan, bearing, distance):
        wide = windows.widened(sensor, errors)
        seen = windows.as_window(wide, windows.around(wide, scan, bearing))
        return windows.candidates(sensor, errors, seen, bearing, distance)

    return lambda scan, *expected: jax.tree.map(
        np.asarray, candidates(scan, *map(np.float32, expected))
    )


@BOTH
@pytest.mark.parametrize("bearing", [-0.1, 0.001, 0.07])  # no half rays
def test_each_window_is_the_plain_one_at_another_bearing(sensor, bearing):
    errors, scan = Search(heading=3.0), readings_of(sensor)
    tried, _, _ = searching(sensor.name, errors)(scan, bearing, 0.8)
    half = len(tried) // 2
    first = windows._first_ray(sensor, jnp.float32(bearing))
    for k in range(-half, half + 1):
        rays = first + sensor.stride * (k + np.arange(sensor.window))
        plain = windows.as_window(sensor, jnp.asarray(scan[rays]))
        np.testing.assert_array_equal(tried[half + k], plain)


def test_a_search_is_as_wide_as_its_errors_explain():
    scan, errors = readings_of(LIDAR), Search(position=0.09, heading=2.0)
    # The middle of 128 rays is half way between two of them.
    ahead = np.radians(240 / 682 / 2)
    for distance in (0.5, 2.0):
        tried, distances, log_prior = searching("lidar", errors)(scan, ahead, distance)
        # 2 degrees, and .09 / .5 = .18 or .09 / 2 = .045 radians, which are 10.3 or 2.58 degrees.
        half = np.hypot(2.0, np.degrees(0.09 / distance))
        middle = len(tried) // 2
        steps = int(half / (240 / 682))
        near = np.isfinite(log_prior).all(axis=0).nonzero()[0]
        np.testing.assert_array_equal(near, np.arange(middle - steps, middle + steps + 1))
        np.testing.assert_allclose(
            distances, distance + np.array([-0.09, -0.06, -0.03, 0.0, 0.03, 0.06, 0.09])
        )
        # The largest errors are three standard deviations: e^-4.5, and at both ends e^-9.
        prior = log_prior - np.max(log_prior)
        np.testing.assert_allclose(prior[0, middle], -4.5, rtol=1e-3)
        off = steps * 240 / 682 / half
        np.testing.assert_allclose(
            prior[[3, 6], middle + steps], [-4.5 * off**2, -4.5 * (1 + off**2)], rtol=1e-3
        )


def readings_of(sensor):
    """A scan in which every reading tells its ray, below the limit of a window."""
    number = len(sensor.angles) * sensor.channels
    shape = (len(sensor.angles), *(() if sensor.channels == 1 else (sensor.channels,)))
    return np.linspace(0.1, 0.9, number, dtype=np.float32).reshape(shape)


# The domain of a detector.

DOMAINS = [windows.make_domain(CONFIG, sensor) for sensor in (CAMERA, LIDAR)]
TURN = 2 * np.pi


def test_limits_are_those_of_the_settings():
    of_camera, of_lidar = DOMAINS
    np.testing.assert_allclose(of_lidar.distance, [0.3, 1.2], rtol=1e-6)
    # 683 beams over 240 degrees; of 640 pixels with a focal length of 320 / tan(40 degrees), every
    # fourth: in the middle 4 / 381.4 rad, at the edge less by the squared cosine of 40 degrees.
    np.testing.assert_allclose(np.degrees(of_lidar.step), 240 / 682, rtol=1e-4)
    middle = 4 / (320 / np.tan(np.radians(40)))
    expected = [middle * np.cos(np.radians(40)) ** 2, middle]
    np.testing.assert_allclose(of_camera.step, expected, rtol=0.01)
    # The camera's pixels lie otherwise beyond 20 degrees and an error of 1; the LiDAR's window of
    # 128 beams may be anywhere in 120 degrees to either side.
    np.testing.assert_allclose(np.degrees(of_camera.bearing), [-21, 21], rtol=1e-5)
    limit = 120 - 64 * 240 / 682
    np.testing.assert_allclose(np.degrees(of_lidar.bearing), [-limit, limit], rtol=1e-4)
    np.testing.assert_allclose([of_camera.range, of_lidar.range], [[1, 1], [1.5, 1.5]])


def test_errors_of_poses_in_training_widen_the_limits():
    errors = LocalisationConfig(in_training=True, error=(0.02, 1.0))
    mission = dataclasses.replace(CONFIG.mission, localisation=errors)
    found = windows.make_domain(dataclasses.replace(CONFIG, mission=mission), CAMERA)
    np.testing.assert_allclose(found.distance, [0.24, 1.26], rtol=1e-5)
    np.testing.assert_allclose(np.degrees(found.bearing), [-24, 24], rtol=1e-5)


def changed(sensor, **changes):
    make = {"camera": sensors.camera, "lidar": sensors.lidar}[sensor.name]
    return make(dataclasses.replace(sensor.config, **changes))


FINE = changed(LIDAR, num_beams=1365)
FAR = changed(LIDAR, window_range=3.0)


@pytest.mark.parametrize(
    ("m", "sensor", "bearing", "distance", "expected"),
    [
        (1, LIDAR, 0.2, 0.3, True),
        (1, LIDAR, 0.2, 1.2, True),
        (1, LIDAR, 0.2, 1.21, False),
        (1, LIDAR, 0.2, np.nan, False),
        (1, LIDAR, 1.69, 1.0, True),
        (1, LIDAR, 1.71, 1.0, False),
        (1, LIDAR, 1.69 + TURN, 1.0, True),
        (1, LIDAR, 1.71 - TURN, 1.0, False),
        (1, LIDAR, np.nan, 1.0, False),
        (0, CAMERA, 0.36, 1.0, True),
        (0, CAMERA, 0.37, 1.0, False),
        (1, FINE, 0.0, 1.0, False),
        (1, FAR, 0.0, 1.0, False),
        (0, changed(CAMERA, field_of_view=60.0), 0.0, 1.0, False),
        (1, changed(LIDAR, range_noise=0.03), 0.0, 1.0, True),
    ],
)
def test_a_look_is_known_within_all_limits(m, sensor, bearing, distance, expected):
    given = sensor, jnp.float32(bearing), jnp.float32(distance)
    assert bool(DOMAINS[m].contains(*given)) is expected


@pytest.mark.parametrize(
    ("sensor", "readings", "is_valid"),
    [
        (CAMERA, [0.0, 0.5, 1.0, 1.01, -0.1, np.nan], [1, 1, 1, 0, 0, 0]),
        (LIDAR, [0.0, 90.0, np.inf, -1.0, -np.inf, np.nan], [1, 1, 1, 0, 0, 0]),
    ],
)
def test_readings_that_are_none_are_told(sensor, readings, is_valid):
    np.testing.assert_array_equal(sensor.is_valid(jnp.array(readings)), is_valid)
