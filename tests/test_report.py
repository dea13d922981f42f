"""The plot of the latent space says what is in it."""

from dataclasses import replace

import numpy as np
import pytest

from jaxsense import report
from jaxsense.config import PRESETS
from jaxsense.types import Belief

CONFIG = PRESETS["smoke"]
CENTRES = np.array([[2.0, 0.0], [-2.0, 0.0], [-2.0, 0.05]])  # the last two look alike


def posteriors(outlier=None):
    noise = 0.01 * np.random.default_rng(0).normal(size=(3, 10, 2))
    belief = Belief(CENTRES[:, None] + noise, np.full((3, 10, 2), 0.5))
    if outlier is not None:
        belief = replace(belief, mean=belief.mean.copy())
        belief.mean[0, 0] = outlier
    return dict.fromkeys(("joint", "camera", "lidar"), belief)


def drawn(outlier=None):
    figure = report.latent_space(CONFIG, posteriors(outlier))
    figure.draw_without_rendering()
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    return figure.axes[0], labels


def test_classes_are_named_above_their_ellipses_and_together_where_they_look_alike():
    axes, _ = drawn()
    names = {text.get_text(): text for text in axes.texts}
    assert set(names) == {"(1)", "(2) & (3)"}
    for text in names.values():
        box = text.get_window_extent().transformed(axes.transData.inverted())
        assert box.y0 > 0.5  # half an ellipse's height above the centre
        assert box.y1 < axes.get_ylim()[1]


@pytest.mark.parametrize(("outlier", "number"), [(None, 0), ((2.2, 0.3), 3)])
def test_outliers_are_counted_and_crossed(outlier, number):
    axes, labels = drawn(outlier)
    told = [label for label in labels if "not sure" in label]
    assert told == ([f"{number} of 90 detections, where a detector was not sure"] if number else [])
    crosses = [c.get_offsets() for c in axes.collections[1::2] if len(c.get_paths()[0].codes) == 4]
    assert sum(map(len, crosses)) == number / 3


def test_a_latent_space_of_one_dimension_is_drawn():
    flat = {n: Belief(b.mean[..., :1], b.std[..., :1]) for n, b in posteriors().items()}
    report.latent_space(CONFIG, flat).draw_without_rendering()
