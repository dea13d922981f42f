"""Windows and distances that a misplaced robot tries, by hand and against the plain window."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsense import PRESETS
from jaxsense.config.mission import Search
from jaxsense.sim import search, sensors, windows

CAMERA, LIDAR = sensors.make(PRESETS["default"])
BOTH = pytest.mark.parametrize("sensor", [CAMERA, LIDAR], ids=["camera", "lidar"])


def test_a_search_reads_as_many_more_rays_as_its_errors_need():
    # The LiDAR's rays are 240 / 682 = .3519 degrees apart, and 6 / .3519 = 17.05. Every fourth of
    # the camera's is read, 4 x 80 / 639 = .5008 apart, and 6 / .5008 = 11.98.
    heading = Search(heading=6.0)
    assert search.widened(LIDAR, heading).window == LIDAR.window + 2 * 18
    assert search.widened(CAMERA, heading).window == CAMERA.window + 2 * 12
    # .15 m across .3 m are half a radian or 28.65 degrees, and 28.65 / .3519 = 81.41.
    position = Search(position=0.15)
    assert search.widened(LIDAR, position).window == LIDAR.window + 2 * 82
    # The larger of two errors counts more: (6^2 + 28.65^2)^.5 = 29.27, and / .3519 = 83.2.
    both = Search(position=0.15, heading=6.0)
    assert search.widened(LIDAR, both).window == LIDAR.window + 2 * 84
    # The camera has 640 rays, of which 160 are read.
    wide = Search(position=0.3, heading=30.0)
    assert search.widened(CAMERA, wide).window == 160


@functools.cache
def searching(name, errors):
    """Windows, distances and their prior, from a whole scan, a bearing and a distance."""
    sensor = {"camera": CAMERA, "lidar": LIDAR}[name]

    @jax.jit
    def candidates(scan, bearing, distance):
        wide = search.widened(sensor, errors)
        seen = windows.as_window(wide, windows.around(wide, scan, bearing))
        return search.candidates(sensor, errors, seen, bearing, distance)

    return lambda scan, *expected: jax.tree.map(
        np.asarray, candidates(scan, *map(np.float32, expected))
    )


@BOTH
@pytest.mark.parametrize("bearing", [-0.1, 0.001, 0.07])  # no half rays
def test_each_window_is_the_plain_one_at_another_bearing(sensor, bearing):
    errors, scan = Search(heading=3.0), readings_of(sensor)
    found = searching(sensor.name, errors)(scan, bearing, 0.8)
    half = len(found.windows) // 2
    first = windows._first_ray(sensor, jnp.float32(bearing))
    for k in range(-half, half + 1):
        rays = first + sensor.stride * (k + np.arange(sensor.window))
        plain = windows.as_window(sensor, jnp.asarray(scan[rays]))
        np.testing.assert_array_equal(found.windows[half + k], plain)


def test_a_search_is_as_wide_as_its_errors_explain():
    scan, errors = readings_of(LIDAR), Search(position=0.09, heading=2.0)
    # The middle of 128 rays is half way between two of them.
    ahead = np.radians(240 / 682 / 2)
    for distance in (0.5, 2.0):
        found = searching("lidar", errors)(scan, ahead, distance)
        # 2 degrees, and .09 / .5 = .18 or .09 / 2 = .045 radians, which are 10.3 or 2.58 degrees.
        half = np.hypot(2.0, np.degrees(0.09 / distance))
        middle = len(found.windows) // 2
        steps = int(half / (240 / 682))
        near = np.isfinite(found.log_prior).all(axis=0).nonzero()[0]
        np.testing.assert_array_equal(near, np.arange(middle - steps, middle + steps + 1))
        np.testing.assert_allclose(
            found.distances, distance + np.array([-0.09, -0.06, -0.03, 0.0, 0.03, 0.06, 0.09])
        )
        # The largest errors are three standard deviations: e^-4.5, and at both ends e^-9.
        prior = found.log_prior - np.max(found.log_prior)
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
