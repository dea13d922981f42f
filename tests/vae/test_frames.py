"""Frames: what they take out of a window, by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsense import PRESETS
from jaxsense.models import make_frame
from jaxsense.sim import sensors
from jaxsense.vae import frames

CAMERA, LIDAR = sensors.make(PRESETS["default"])
PROFILE = make_frame(LIDAR)
ANGLES = np.asarray(PROFILE.angles)
PLACES = np.linspace(-0.22, 0.22, 64)


def cylinder(distance, bearing, radius=0.1, wall=3.0):
    """Distances to a cylinder before a wall, as a LiDAR measures them."""
    across = distance * np.sin(ANGLES - bearing)
    along = distance * np.cos(ANGLES - bearing)
    hit = np.abs(across) < radius
    ranges = along - np.sqrt(np.maximum(radius**2 - across**2, 0))
    return jnp.asarray(np.where(hit, ranges, wall), jnp.float32)


def test_angles_are_those_of_the_window():
    assert ANGLES.shape == (LIDAR.window,)
    np.testing.assert_allclose(np.diff(ANGLES), np.diff(LIDAR.angles)[:127], atol=1e-6)
    np.testing.assert_allclose(ANGLES.mean(), 0, atol=1e-6)


def test_a_cylinder_has_the_depth_of_a_circle():
    found = np.asarray(PROFILE(cylinder(0.5, 0.0)))
    inside = np.abs(PLACES) < 0.08
    expected = 0.1 - np.sqrt(0.01 - PLACES[inside] ** 2)
    np.testing.assert_allclose(found[inside] - found[inside].min(), expected, atol=0.006)
    # Beyond it, the depth rises to that of the wall.
    assert (np.diff(found[PLACES > 0.11]) > 0).all()
    np.testing.assert_allclose(found, found[::-1], atol=2e-3)


@pytest.mark.parametrize(("distance", "bearing"), [(0.4, 0.0), (0.8, 0.1), (1.1, -0.1)])
def test_distance_and_bearing_are_taken_out(distance, bearing):
    usual, found = PROFILE(cylinder(0.5, 0.0)), PROFILE(cylinder(distance, bearing))
    inside = np.abs(PLACES) < 0.08
    np.testing.assert_allclose(found[inside], usual[inside], atol=0.012)
    assert np.abs(cylinder(distance, bearing) - cylinder(0.5, 0.0)).max() > 1


def test_one_near_outlier_does_not_matter():
    window = cylinder(0.5, 0.0)
    spoilt = window.at[LIDAR.window // 2].set(0.2)
    far = np.abs(PLACES) > 0.05
    np.testing.assert_allclose(PROFILE(spoilt)[far], PROFILE(window)[far], atol=0.01)


def test_chromaticity_keeps_colour_and_tells_brightness_apart():
    frame = make_frame(CAMERA)
    pixels = jnp.array([[0.6, 0.2, 0.1], [0.3, 0.1, 0.05]])
    bright, dark = frame(pixels.reshape(-1)).reshape(2, 3)
    # (r + g + b) + .03: shares .645 and .215, then .625 and .208.
    np.testing.assert_allclose(bright, [0.6 / 0.93, 0.2 / 0.93, np.log(0.93)], rtol=1e-5)
    np.testing.assert_allclose(dark, [0.3 / 0.48, 0.1 / 0.48, np.log(0.48)], rtol=1e-5)


def test_other_sensors_are_seen_as_they_are():
    window = jnp.arange(4.0)
    np.testing.assert_array_equal(frames.make(np.zeros(4), 1, False)(window), window)
    assert isinstance(frames.make(np.zeros(2), 2, True), frames.Plain)


def test_scaling_standardises_by_the_training():
    windows = 3.0 + 2.0 * jax.random.normal(jax.random.key(0), (500, 4))
    scaling, seen = frames.scaled(frames.Plain(), windows)
    np.testing.assert_allclose(seen.mean(axis=0), 0, atol=1e-5)
    np.testing.assert_allclose(seen.std(), 1, rtol=1e-3)
    np.testing.assert_allclose(jax.vmap(scaling)(windows), seen, rtol=1e-4, atol=1e-5)
