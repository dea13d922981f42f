"""Frames: what they take out of a window, by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsense import PRESETS
from jaxsense.models import make_frame
from jaxsense.sim import sensors
from jaxsense.vae import frames

CONFIG = PRESETS["default"]
CAMERA, LIDAR = sensors.make(CONFIG)
PROFILE = make_frame(CONFIG, LIDAR)
ANGLES = np.arctan2(PROFILE.across, PROFILE.along)
EXTENT = 0.1 * np.sqrt(2)
PLACES = 1.5 * EXTENT * np.linspace(-1, 1, 64)


@jax.jit
def profile(window):
    return PROFILE(window)


def cylinder(distance, bearing, radius=0.1, wall=3.0):
    """Distances to a cylinder before a wall, as a LiDAR measures them."""
    across = distance * np.sin(ANGLES - bearing)
    along = distance * np.cos(ANGLES - bearing)
    hit = np.abs(across) < radius
    ranges = along - np.sqrt(np.maximum(radius**2 - across**2, 0))
    return jnp.asarray(np.where(hit, ranges, wall), jnp.float32)


def test_a_cylinder_has_the_depth_of_a_circle():
    found = np.asarray(profile(cylinder(0.5, 0.0)))
    inside = np.abs(PLACES) < 0.08
    expected = 0.1 - np.sqrt(0.01 - PLACES[inside] ** 2)
    np.testing.assert_allclose(found[inside] - found[inside].min(), expected, atol=0.006)
    # Where no beam has hit it, the depth is the largest, 2.1 extents.
    np.testing.assert_allclose(found[np.abs(PLACES) > 0.115], 2.1 * EXTENT, rtol=1e-5)
    np.testing.assert_allclose(found, found[::-1], atol=2e-3)


def test_a_profile_is_not_mirrored():
    found = np.asarray(profile(jnp.where(ANGLES > 0, 0.5, 0.55)))  # 5 cm deeper to the right
    left, right = (found[(x > 0.02) & (x < 0.08)].mean() for x in (PLACES, -PLACES))
    assert right - left == pytest.approx(0.05, abs=0.005)


@pytest.mark.parametrize(("distance", "bearing"), [(0.4, 0.0), (0.8, 0.1), (1.1, -0.1)])
def test_distance_and_bearing_are_taken_out(distance, bearing):
    usual, found = profile(cylinder(0.5, 0.0)), profile(cylinder(distance, bearing))
    inside = np.abs(PLACES) < 0.08
    np.testing.assert_allclose(found[inside], usual[inside], atol=0.012)
    assert np.abs(cylinder(distance, bearing) - cylinder(0.5, 0.0)).max() > 1


def test_chromaticity_keeps_colour_and_drops_the_light():
    frame = make_frame(CONFIG, CAMERA)
    pixels = jnp.array([[0.6, 0.2, 0.1], [0.03, 0.01, 0.05]])
    bright, dark = frame(pixels.reshape(-1)).reshape(2, 3)
    # Brightness .9 and .09, mean .495, and .03: over 1.425 and .615.
    np.testing.assert_allclose(bright, [0.6 / 1.425, 0.2 / 1.425, 0.1 / 1.425], rtol=1e-5)
    np.testing.assert_allclose(dark, [0.03 / 0.615, 0.01 / 0.615, 0.05 / 0.615], rtol=1e-5)
    half = frame(0.5 * pixels.reshape(-1)).reshape(2, 3)
    np.testing.assert_allclose(half, [bright, dark], rtol=0.06)


def test_scaling_standardises_by_the_training():
    windows = 3.0 + 2.0 * jax.random.normal(jax.random.key(0), (500, 4))
    scaling, seen = frames.scaled(frames.Frame(), windows)
    np.testing.assert_allclose(seen.mean(axis=0), 0, atol=1e-5)
    np.testing.assert_allclose(seen.std(), 1, rtol=1e-3)
    np.testing.assert_allclose(jax.vmap(scaling)(windows), seen, rtol=1e-4, atol=1e-5)


def test_the_front_is_sought_as_far_as_the_bearing_may_be_wrong():
    near_only = frames.profile(ANGLES, EXTENT, 0.0)
    # A pole 2 cm wide at .108 rad, beyond .1 and within .1 and a bearing error of 1 degree.
    window = cylinder(1.0, 0.108, radius=0.01)
    assert np.asarray(profile(window)).max() > 2 * EXTENT  # the pole, with nothing to its sides
    assert np.asarray(near_only(window)).max() < 0  # the wall behind
    # At least to the next beams.
    coarse = frames.profile(np.array([-0.2, 0.0, 0.2]), EXTENT, 0.0)
    assert coarse.ahead == pytest.approx(np.sin(0.202))


def test_what_stands_around_a_poi_does_not_turn_the_profile():
    """The middle is that of the beams on the PoI alone, whatever stands next to it."""
    alone, usual = cylinder(0.5, 0.0), profile(cylinder(0.5, 0.0))
    aside = jnp.where((ANGLES > 0.25) & (ANGLES < 0.35), 0.8, alone)  # 0.3 m behind
    inside = np.abs(PLACES) < 0.08
    np.testing.assert_allclose(profile(aside)[inside], usual[inside], atol=1e-6)
    alone = cylinder(1.0, 0.0)
    far = jnp.where(ANGLES > 0.3, 1.0, alone)  # as near as the PoI, but 0.3 m to its side
    np.testing.assert_allclose(profile(far)[inside], profile(alone)[inside], atol=1e-6)
    # Nor is one beam alone that falls short its front.
    short, beside = cylinder(0.5, 0.0).at[len(ANGLES) // 2].set(0.2), np.abs(PLACES - 0.05) < 0.02
    np.testing.assert_allclose(profile(short)[beside], usual[beside], atol=1e-3)
