"""The looks that a detector has learned from, and what detection says of others."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from jaxsense.config import PRESETS
from jaxsense.config.mission import LocalisationConfig
from jaxsense.sim import sensors
from jaxsense.sim.domain import make_domain

CONFIG = PRESETS["smoke"]
CAMERA, LIDAR = sensors.make(CONFIG)
DOMAINS = [make_domain(CONFIG, sensor) for sensor in (CAMERA, LIDAR)]
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
    found = make_domain(dataclasses.replace(CONFIG, mission=mission), CAMERA)
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
