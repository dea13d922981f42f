"""Disturbances of the sensors: hand-worked cases, and nothing at all while they are off."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

from jaxsense import sim
from jaxsense.config import CameraConfig, LidarConfig
from jaxsense.config.scene import ViewpointConfig
from jaxsense.sim import light as lights
from jaxsense.sim import sensors, windows, world
from jaxsense.sim.light import Light, random_conditions
from jaxsense.sim.raycast import Hit

NUMBER = 20_000
KEYS = jax.random.split(jax.random.key(0), NUMBER)
EXACT = {"range_noise": 0.0, "max_range": 5.0}


TENTHS = jnp.arange(10) / 10


@jax.jit
def measure(distance, config):
    hits = Hit(distance, 0 * distance, (distance, distance))
    light: Any = None
    return jax.vmap(lambda key: sensors.lidar(config).read(key, hits, {}, light))(KEYS)


def ranges(distance, **settings):
    """`[NUMBER, B]` measurements of the same distances, by one program."""
    beams = np.full(8, np.inf, np.float32)
    beams[: len(distance)] = distance
    return np.asarray(measure(beams, LidarConfig(**settings)))[:, : len(distance)]


def test_noise_grows_with_the_distance():
    for growth, deviations in ((0.01, [0.03, 0.06]), (0.0, [0.02, 0.02])):
        found = ranges([1.0, 4.0, np.inf], range_noise=0.02, range_noise_growth=growth)
        # Standard errors of 20,000 draws: half a percent of a deviation, .0004 of the larger mean.
        np.testing.assert_allclose(found[:, :2].std(axis=0), deviations, rtol=0.015)
        np.testing.assert_allclose(found[:, :2].mean(axis=0), [1.0, 4.0], atol=0.0012)
        np.testing.assert_array_equal(found[:, 2], 5.0)


def test_a_mixed_pixel_lies_between_its_surface_and_the_next():
    clean = [1.0, 1.0, 3.0, 2.0, np.inf, 2.0, 6.0, 4.0]
    found = ranges(clean, mixed_pixels=0.25, **EXACT)
    # Nothing lies between a surface and nothing, nor one beyond the range; the last is alone.
    edges, others = [1, 2], [0, 3, 4, 5, 6, 7]
    expected = np.minimum(clean, 5.0)[others]
    np.testing.assert_array_equal(found[:, others], np.broadcast_to(expected, (NUMBER, 6)))
    for beam in edges:
        low, high = sorted(clean[beam : beam + 2])
        mixed = found[:, beam][found[:, beam] != clean[beam]]
        assert len(mixed) / NUMBER == pytest.approx(0.25, abs=0.015)
        assert low < mixed.min() < mixed.max() < high
        assert mixed.mean() == pytest.approx((low + high) / 2, abs=0.05)


@pytest.fixture(scope="module")
def scans(arena, place, known_layout):
    """`[NUMBER, window]` readings of windows, and those of the same windows of whole scans."""
    data = place(known_layout, jnp.array([[0.5, 0.0, np.pi], [-0.5, 0.0, 0.0]]))

    @jax.jit
    def read(sensor, bearing):
        robot = int(sensor.measures_distance)
        simulation = sim.World(arena, (sensor, sensor), ViewpointConfig(), None)

        def each(key):
            scan_key, light_key = jax.random.split(key)
            light = Light(jnp.array([0.8, 0.0, 0.6]), jnp.float32(0.5), jnp.float32(0.25))
            light = dataclasses.replace(light, conditions=random_conditions(light_key))
            scene = sim.Scene(known_layout, light, jnp.zeros((2, 3)))
            window = world.scan_around(scan_key, simulation, scene, data, robot, bearing, robot)
            rays = sensor.directions
            whole = sim.scan(scan_key, sensor, arena, data, known_layout, light, robot, rays)
            return window, windows.around(sensor, whole, bearing)

        first, second = jnp.split(KEYS[:6000], 2)
        return jax.vmap(each)(first)[0], jax.vmap(each)(second)[1]

    return read


CAMERA = CameraConfig(shadow=0.8, num_pixels=64, window=16, stride=2)
LIDAR = LidarConfig(range_noise=0.001, mixed_pixels=0.5, dropout=0.05, window=12)


@pytest.mark.parametrize(
    ("sensor", "bearing"),
    [
        pytest.param(sensors.camera(CAMERA), 0.1, marks=pytest.mark.slow),
        # The cylinder ahead ends with beam 373, at .2 rad.
        (sensors.lidar(LIDAR), 0.172),
    ],
)
def test_a_window_has_the_statistics_of_a_whole_scan(scans, sensor, bearing):
    window, whole = (np.reshape(x, (3000, sensor.window, -1)) for x in scans(sensor, bearing))
    both = window[..., -1], whole[..., -1]
    assert all(scipy.stats.ks_2samp(*rays).pvalue > 1e-4 for rays in np.moveaxis(both, 2, 0))
    # Together, too: how much of a window is in shadow, and how many beams are mixed.
    for of_scan in (np.mean, np.std, np.ptp):
        pair = (of_scan(x, axis=1) for x in both)
        assert scipy.stats.ks_2samp(*pair).pvalue > 1e-4


def test_a_beam_that_drops_out_reads_as_one_without_a_return():
    found = ranges([1.0, 2.0], dropout=0.3, **EXACT)
    assert np.mean(found == 5.0) == pytest.approx(0.3, abs=0.01)
    assert set(np.unique(found)) == {1.0, 2.0, 5.0}
    # Each beam by itself.
    assert np.mean(np.all(found == 5.0, axis=1)) == pytest.approx(0.09, abs=0.01)


def test_hand_worked_light():
    config = CameraConfig(exposure_error=0.5, colour_cast=0.1, low_light=0.8, shadow=0.4)
    # A standard normal value is below -.253347 with a chance of .4, below .524401 with .7, and
    # below .5 with .691.
    values = jnp.array([2.0, 1.0, 0.0, -1.0, 0.524401, -0.2534, 0.5, 0.1])
    gain, is_lit = lights.lighting(values, TENTHS, config)
    # (1 - .8 * .7) exp(.5 * 2 + .1 * {1, 0, -1}); dark before pixel 7, the first beyond .691.
    expected = 0.44 * np.exp([1.1, 1.0, 0.9])
    np.testing.assert_allclose(gain, expected, rtol=1e-5)
    np.testing.assert_array_equal(is_lit, [0] * 7 + [1] * 3)
    _, is_lit = lights.lighting(values.at[7].set(-0.1), TENTHS, config)
    np.testing.assert_array_equal(is_lit, [1] * 7 + [0] * 3)
    _, is_lit = lights.lighting(values.at[5].set(-0.2532), TENTHS, config)
    np.testing.assert_array_equal(is_lit, 1)


def test_a_shadow_leaves_the_ambient_light():
    camera = sensors.camera(CameraConfig(pixel_noise=0.0, shadow=1.0))
    light = Light(
        jnp.array([1.0, 0.0, 0.0]),
        jnp.float32(0.5),
        jnp.float32(0.25),
        random_conditions(KEYS[0]),
        jnp.zeros(3),
    )
    rays = jnp.ones(80)
    hits = Hit(rays, jnp.zeros(80, jnp.int32), (rays, 0 * rays), 8.0 * jnp.arange(80))
    colour = {"colour": jnp.array([[0.8, 0.4, 0.2]])}
    image = np.asarray(camera.read(KEYS[0], hits, colour, light))
    lit, dark = 0.75 * np.array([0.8, 0.4, 0.2]), 0.25 * np.array([0.8, 0.4, 0.2])
    is_lit = np.isclose(image, lit).all(axis=1)
    assert 0 < is_lit.sum() < 80
    np.testing.assert_allclose(image[~is_lit], np.broadcast_to(dark, (80 - is_lit.sum(), 3)))
