"""Windows and distances that a misplaced robot tries, by hand and against the plain window."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from jaxsense import PRESETS
from jaxsense.config import ConfigError, SearchConfig
from jaxsense.sim import search, sensors, windows

CAMERA, LIDAR = sensors.make(PRESETS["default"])
BOTH = pytest.mark.parametrize("sensor", [CAMERA, LIDAR], ids=["camera", "lidar"])


@BOTH
def test_who_does_not_search_reads_the_plain_window(sensor):
    assert search.widened(sensor, SearchConfig()) == sensor
    found = search.candidates(
        *(sensor, SearchConfig(), readings_of(sensor)[: sensor.window]),
        *(jnp.float32(0.1), jnp.float32(0.8)),
    )
    np.testing.assert_array_equal(found.distances, [np.float32(0.8)])
    assert found.is_near.tolist() == [True]


def test_a_search_reads_as_many_more_rays_as_its_errors_need():
    # The LiDAR's rays are 240 / 682 = .3519 degrees apart, and 6 / .3519 = 17.05. Every fourth of
    # the camera's is read, 4 x 80 / 639 = .5008 apart, and 6 / .5008 = 11.98.
    heading = SearchConfig(heading=6.0)
    assert search.widened(LIDAR, heading).window == LIDAR.window + 2 * 18
    assert search.widened(CAMERA, heading).window == CAMERA.window + 2 * 12
    # .15 m across .3 m are asin(.5) = 30 degrees, and 30 / .3519 = 85.25.
    position = SearchConfig(position=0.15)
    assert search.widened(LIDAR, position).window == LIDAR.window + 2 * 86
    # The camera has 640 rays, of which 160 are read.
    wide = SearchConfig(position=0.3, heading=30.0)
    assert search.widened(CAMERA, wide).window == 160


@BOTH
@pytest.mark.parametrize("bearing", [-0.1, 0.001, 0.07])  # no half rays
def test_each_window_is_the_plain_one_at_another_bearing(sensor, bearing):
    errors, scan = SearchConfig(heading=3.0), readings_of(sensor)
    wide = windows.around(search.widened(sensor, errors), scan, jnp.float32(bearing))
    found = search.candidates(sensor, errors, wide, jnp.float32(bearing), jnp.float32(0.8))
    half = len(found.windows) // 2
    first = windows._first_ray(sensor, jnp.float32(bearing))
    for k in range(-half, half + 1):
        rays = first + sensor.stride * (k + np.arange(sensor.window))
        plain = windows.as_window(sensor, jnp.asarray(scan[rays]))
        np.testing.assert_array_equal(found.windows[half + k], plain)


def test_a_search_is_as_wide_as_its_errors_explain():
    scan, errors = readings_of(LIDAR), SearchConfig(position=0.09, heading=2.0)
    wide = windows.around(search.widened(LIDAR, errors), scan, jnp.float32(0.0))
    for distance in (0.5, 2.0):
        found = search.candidates(LIDAR, errors, wide, jnp.float32(0.0), jnp.float32(distance))
        # 2 degrees and asin(.09 / .5) = 10.37, or asin(.09 / 2) = 2.58, to either side.
        half = 2.0 + np.degrees(np.arcsin(0.09 / distance))
        expected = 2 * np.floor(half / (240 / 682)) + 1
        assert abs(found.is_near.sum() - expected) <= 1
        middle = len(found.is_near) // 2
        assert found.is_near[middle]
        np.testing.assert_allclose(
            found.distances, distance + np.array([-0.09, -0.06, -0.03, 0.0, 0.03, 0.06, 0.09])
        )


def test_robots_that_search_keep_away_by_the_error_of_their_position():
    config = PRESETS["default"]

    def searching(position):
        errors = SearchConfig(position=position)
        localisation = replace(config.mission.localisation, search=errors)
        return replace(config, mission=replace(config.mission, localisation=localisation))

    assert searching(0.2).mission.localisation.search.applies
    # .3 m, the nearest look of training, and .21 m are beyond the viewpoints at .5 m.
    with pytest.raises(ConfigError, match=r"view_distances.*from 0.510 m"):
        searching(0.21)


def readings_of(sensor):
    """A scan in which every reading tells its ray, below the limit of a window."""
    number = len(sensor.angles) * sensor.channels
    shape = (len(sensor.angles), *(() if sensor.channels == 1 else (sensor.channels,)))
    return np.linspace(0.1, 0.9, number, dtype=np.float32).reshape(shape)
