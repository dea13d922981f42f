"""The plots of a run say what is in them, in colours that all can tell apart."""

import jax
import numpy as np
import pytest

from jaxsense.config import PRESETS
from jaxsense.core.types import Belief
from jaxsense.show import colours, plots
from jaxsense.sim import sensors
from jaxsense.training.measures import diagram

CONFIG = PRESETS["smoke"]
CURVES = {"reward": np.arange(40.0), "evaluation": np.full(40, np.nan)}
CURVES["evaluation"][[9, 19, 29, 39]] = [1.0, 2.0, 3.0, 4.0]
AGENT = {"return": 4.0, "optimal": 4.5, "naive": 3.0, "random": -1.0}


def lines(axes):
    return {line.get_label(): line for line in axes.lines}


def test_the_evaluation_is_drawn_where_it_was_played():
    (axes,) = plots.rewards({"camera": CURVES}, {"camera": AGENT}).axes
    drawn = lines(axes)
    np.testing.assert_array_equal(drawn["without exploration"].get_xdata(), [9, 19, 29, 39])
    np.testing.assert_array_equal(drawn["without exploration"].get_ydata(), [1, 2, 3, 4])
    # The mean of the last 20 epochs, from 20 to 39.
    assert drawn["exploring"].get_ydata()[-1] == 29.5
    assert drawn["optimal"].get_ydata()[0] == 4.5
    # The axis begins as far below naive exploration as the optimum is above; a text has the rest.
    assert axes.get_ylim()[0] == 1.5
    names = {text.get_text() for text in axes.get_legend().get_texts()}
    assert names == {*drawn} == {
        "exploring", "without exploration", "optimal", "naive", "random: -1.00, below"
    }  # fmt: skip
    # A bad policy is shown too, .5 below it. Robots alone on the map share an axis.
    bad = {"return": -2.0, "optimal": 3.0, "naive": 3.0, "random": -1.0}
    both = {"camera": CURVES, "lidar": CURVES}
    one, other = plots.rewards(both, {"camera": AGENT, "lidar": bad}).axes
    assert one.get_ylim() == other.get_ylim()
    assert one.get_ylim()[0] == -2.5
    assert "random" in lines(other)


def test_a_detector_that_is_calibrated_lies_on_the_diagonal():
    # Of ten looks at a class, nine say so with .9, and one says the opposite. A bin of fewer than
    # twenty looks, six with .8, is left out.
    right, wrong, rare = [0.9, 0.1], [0.1, 0.9], [0.8, 0.2]
    looks = ([right] * 9 + [wrong]) * 2 + [wrong] * 9 + [right] + [rare] * 6
    found = jax.tree.map(np.asarray, diagram(np.array(looks), np.repeat([0, 1, 0], [20, 10, 6])))
    belief = {"looks": [1, 2], "nll": [0.5, 0.2], "bayes_nll": [0.4, 0.1]}
    figure = plots.calibration(CONFIG, {"lidar": found}, belief)
    detectors, beliefs = map(lines, figure.axes)
    points = np.array(detectors["lidar"].get_data())
    np.testing.assert_allclose(points[np.isfinite(points)], [0.9, 0.9], rtol=1e-6)
    np.testing.assert_array_equal(beliefs["map"].get_ydata(), [0.5, 0.2])
    np.testing.assert_array_equal(beliefs["exact Bayes"].get_ydata(), [0.4, 0.1])


def test_camera_and_lidar_are_drawn_from_left_to_right():
    # Camera and LiDAR see 0.4 of full scale, on the left 0.8.
    windows = {}
    for sensor in sensors.make(CONFIG):
        is_left = sensor.angles[:: sensor.stride][: sensor.window]
        readings = np.where(is_left > np.median(is_left), 0.8, 0.4)[:, None]
        readings = np.repeat(readings, sensor.channels, axis=1).reshape(1, -1)
        windows[sensor.name] = sensor.from_left(np.repeat(readings, 3, axis=0))
    axes = np.reshape(plots.scanlines(CONFIG, windows).axes, (3, 2))
    assert [row[0].get_ylabel() for row in axes] == [*CONFIG.arena.classes]
    assert [ax.get_title() for ax in axes[0]] == ["camera", "lidar"]
    # The PoI is expected in the middle.
    for ax, number in zip(axes[0], (CONFIG.camera.window, CONFIG.lidar.window), strict=True):
        assert ax.lines[-1].get_xdata()[0] == (number - 1) / 2
    # 1.055 * 0.8^(1 / 2.4) - 0.055 = 0.9063 and 1.055 * 0.4^(1 / 2.4) - 0.055 = 0.6652
    pixels = np.asarray(axes[0, 0].images[0].get_array()[0])
    np.testing.assert_allclose(pixels[[0, -1]], [[0.9063] * 3, [0.6652] * 3], atol=1e-4)
    # Near black it is linear: 12.92 * 0.002 = 0.02584.
    np.testing.assert_allclose(colours.as_srgb(np.array([0.0, 0.002, 1.0])), [0, 0.02584, 1])
    ranges = axes[0, 1].lines[0].get_ydata()
    assert ranges[0] > ranges[-1]
    # All distances on one scale.
    for ax in axes[:, 1]:
        assert ax.get_ylim() == (0.0, pytest.approx(1.05 * 0.8))


def test_every_belief_and_every_norm_is_shown():
    centres = np.array([[2.0, 0.0], [-2.0, 0.0], [-2.0, 0.05]])
    belief = Belief(np.repeat(centres[:, None], 10, axis=1), np.full((3, 10, 2), 0.5))
    figure = plots.latent_space(CONFIG, dict.fromkeys(("joint", "camera", "lidar"), belief))
    axes, below = figure.axes[0], figure.axes[3]
    places = [each.get_offsets() for each in axes.collections[1::2]]
    np.testing.assert_allclose(places, belief.mean)
    assert [text.get_text() for text in below.get_yticklabels()] == [*CONFIG.arena.classes]
    for c, points in enumerate(each.get_offsets() for each in below.collections):
        np.testing.assert_allclose(points[:, 0], np.sqrt(0.5))
        assert np.abs(points[:, 1] - c).max() < 0.5
