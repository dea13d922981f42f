"""All networks together: what they are before training, and what a whole scan shows them."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from untrained import untrained

import jaxsense
from jaxsense import models
from jaxsense.config import PRESETS, LidarConfig
from jaxsense.config.mission import Search
from jaxsense.sim import sensors
from jaxsense.vae.frames import Chromaticity, Frame, Profile

SMOKE, KEY = PRESETS["smoke"], jax.random.key(0)
SCANS = replace(SMOKE, jmvae=replace(SMOKE.jmvae, learns_from="scans", fusion="filter"))
TEAM = replace(
    SMOKE,
    dqn=replace(SMOKE.dqn, task="team"),
    team=replace(SMOKE.team, num_pois=(3, 7)),
)
CAMERA, LIDAR = sensors.make(SMOKE)


def shapes_of(config):
    return jax.eval_shape(lambda: jaxsense.init(KEY, config))


def test_before_training_no_class_is_known_and_no_look_has_a_value():
    found = untrained(SMOKE)
    np.testing.assert_array_equal(found.fusion.classes.mean, np.zeros((3, 2)))
    np.testing.assert_array_equal(found.fusion.classes.std, np.ones((3, 2)))
    np.testing.assert_allclose(found.fusion.prior.std, 20**0.5, rtol=1e-6)
    assert not any(np.any(leaf) for leaf in jax.tree.leaves(found.look_values))
    np.testing.assert_array_equal(found.novelty.weight(jnp.zeros(3), 0), 1.0)
    kernels = [x["params"]["Dense_0"]["kernel"] for x in found.q_networks]
    assert np.any(kernels[0] != kernels[1])


def test_an_agent_is_that_of_its_task():
    one, team = models.make_agent(SMOKE), models.make_agent(TEAM)
    assert (one.num_pois, one.travel) == (3, None)
    assert team.num_pois == 7
    assert team.travel.view_distance == pytest.approx(TEAM.navigation.view_range - 0.02)


def test_networks_that_learn_from_scans_see_windows_in_frames():
    assert models.make_scan_jmvae(SCANS).feature_sizes == (CAMERA.window * 3, 64)
    found = shapes_of(SCANS).detectors
    assert [each.presence.num_labels for each in found] == [1, 1]
    assert [each.num_labels for each in shapes_of(SMOKE).detectors] == [2, 2]
    assert [each.scaling.offset.shape for each in found] == [(240,), (64,)]


@pytest.mark.parametrize(("window", "kind"), [(2, Frame), (3, Profile), (41, Profile)])
def test_three_beams_are_the_fewest_of_a_profile(window, kind):
    lidar = sensors.lidar(LidarConfig(num_beams=61, field_of_view=60.0, window=window))
    found = models.make_frame(SMOKE, lidar)
    assert type(found) is kind
    assert type(models.make_frame(SMOKE, CAMERA)) is Chromaticity
    if window == 41:
        np.testing.assert_allclose(found.across, np.sin(np.radians(np.arange(-20, 21))), atol=1e-6)
        # Its window ends 10 degrees before the view does, and PoIs are seen up to 20 aside: 10 of
        # them, 1 of the bearing's error, and .1 rad.
        np.testing.assert_allclose(found.ahead, np.sin(0.1 + np.radians(11)), rtol=1e-5)


def test_a_look_is_known_within_what_was_learned_if_its_window_was_recorded():
    trained, ahead = untrained(SMOKE), np.full(683, 0.7)
    lost, edge, aside, nothing, zero = (ahead.copy() for _ in range(5))
    # The window is of 128 beams around 341 + .1 / .00614.
    lost[341] = edge[295] = aside[0] = np.nan
    nothing[341], zero[341] = np.inf, 0.0
    cases = [
        (edge, 0.1, 0.8, False),  # where a search finds other windows
        (ahead, 0.1, 0.8, True),
        (ahead, 0.1 + 2 * np.pi, 0.8, True),
        (aside, 0.1, 0.8, True),
        (nothing, 0.1, 0.8, True),
        (zero, 0.1, 0.8, True),
        (lost, 0.1, 0.8, False),
        (-ahead, 0.1, 0.8, False),
        (ahead, 0.1, 1.25, False),
        (ahead, 0.1, np.nan, False),
        (ahead, 1.8, 0.8, False),
    ]
    scans, bearings, distances, known = (jnp.array(x) for x in zip(*cases, strict=True))
    for search in (Search(), Search(heading=2.0)):
        detect = lambda *look, search=search: trained.detect(1, LIDAR, *look, search)  # noqa: E731
        found = jax.jit(jax.vmap(detect))(scans, bearings, distances)
        expected = known.at[0].set(search.applies)
        np.testing.assert_array_equal(found.is_known, expected)
        np.testing.assert_array_equal(found.is_there, expected)  # has no threshold yet
        assert np.all(np.ptp(found.features, axis=1)[expected] > 0)
        np.testing.assert_array_equal(found.features[~expected], 0.5)
        for one, other in ((1, 2), (4, 5)):
            np.testing.assert_allclose(found.features[one], found.features[other], atol=1e-4)
