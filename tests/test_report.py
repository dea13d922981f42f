"""The plots of scans and of the latent space say what is in them."""

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.collections import PatchCollection, PathCollection

from jaxsense.config import PRESETS, SHAPES, ArenaConfig, Attribute, Shape
from jaxsense.core.types import Belief
from jaxsense.show import colours, latent_plots, scan_plots
from jaxsense.sim import sensors

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
    figure = latent_plots.latent_space(CONFIG, posteriors(outlier))
    figure.draw_without_rendering()
    labels = [text.get_text() for legend in figure.legends for text in legend.get_texts()]
    return figure.axes[0], labels


def test_classes_are_named_above_their_ellipses_and_together_where_they_look_alike():
    axes, _ = drawn()
    names = {text.get_text(): text for text in axes.texts}
    assert set(names) == {"green cylinder", "red cylinder\nred cube"}
    for text in names.values():
        box = text.get_window_extent().transformed(axes.transData.inverted())
        assert box.y0 > 0.5  # half an ellipse's height above the centre
        assert box.y1 < axes.get_ylim()[1]


@pytest.mark.parametrize(("outlier", "number"), [(None, 0), ((2.2, 0.3), 3)])
def test_outliers_are_counted_and_crossed(outlier, number):
    axes, labels = drawn(outlier)
    told = [label for label in labels if "far from" in label]
    assert told == ([f"{number} of 90 detections, far from most of their class"] if number else [])
    points = [c for c in axes.collections if isinstance(c, PathCollection)]
    crosses = [c.get_offsets() for c in points if len(c.get_paths()[0].codes) == 4]
    assert sum(map(len, crosses)) == number / 3


def test_of_classes_in_one_place_all_ellipses_are_seen():
    axes, _ = drawn()
    ellipses = [c for c in axes.collections if isinstance(c, PatchCollection)]
    (green,), (red,), (cube,) = (each.get_linestyle() for each in ellipses)
    assert green[1] is None  # solid, for it is alone
    # Each draws where the other leaves gaps, of one length.
    assert red[1][0] == red[1][1] == cube[1][0] == cube[1][1]
    assert cube[0] - red[0] == red[1][0]
    points = [c for c in axes.collections if isinstance(c, PathCollection)]
    shapes = {len(c.get_paths()[0].vertices) for c in points if len(c.get_offsets())}
    assert len(shapes) > 1  # for those who see no red and no green
    assert all(len(c.get_facecolors()) == 0 for c in points if len(c.get_offsets()))


def test_ellipses_that_nobody_can_tell_apart_are_drawn_once():
    same = Belief(np.repeat(CENTRES[:, None], 10, axis=1), np.full((3, 10, 2), 0.5))
    figure = latent_plots.latent_space(CONFIG, dict.fromkeys(("joint", "camera", "lidar"), same))
    ellipses = [c for c in figure.axes[0].collections if isinstance(c, PatchCollection)]
    assert [len(each.get_paths()) for each in ellipses] == [1, 1, 1]
    assert ellipses[0].get_alpha() == pytest.approx(1 - 0.5**10)


def test_many_outliers_do_not_bury_the_classes():
    belief = posteriors()["joint"]
    belief.mean[:, :4] += 1.0
    figure = latent_plots.latent_space(CONFIG, dict.fromkeys(("joint", "camera", "lidar"), belief))
    ellipses = [c for c in figure.axes[0].collections if isinstance(c, PatchCollection)]
    faint = np.concatenate([np.atleast_1d(each.get_alpha()) for each in ellipses[:2]])
    assert sorted(set(np.round(faint, 2))) == [0.17, 0.5]  # .5 * 4 / 12 where twelve are apart


def test_the_uncertainty_of_each_class_stands_in_its_own_row():
    figure = latent_plots.latent_space(CONFIG, posteriors())
    below = figure.axes[3]
    assert [label.get_text() for label in below.get_yticklabels()] == [*CONFIG.arena.classes]
    rows = [c.get_offsets() for c in below.collections]
    for c, points in enumerate(rows):
        np.testing.assert_allclose(points[:, 0], np.sqrt(0.5))
        assert np.abs(points[:, 1] - c).max() < 0.5


def test_a_latent_space_of_one_dimension_is_drawn():
    flat = {n: Belief(b.mean[..., :1], b.std[..., :1]) for n, b in posteriors().items()}
    latent_plots.latent_space(CONFIG, flat).draw_without_rendering()


@pytest.fixture(scope="module")
def scanlines():
    """Axes of a plot in which camera and LiDAR see a position 0.4 full scale, on the left 0.8."""
    windows = {}
    for sensor in sensors.make(CONFIG):
        is_left = sensor.angles[:: sensor.stride][: sensor.window]
        readings = np.where(is_left > np.median(is_left), 0.8, 0.4)[:, None]
        readings = np.repeat(readings, sensor.channels, axis=1).reshape(1, -1)
        windows[sensor.name] = sensor.from_left(np.repeat(readings, 3, axis=0))
    figure = scan_plots.scanlines(CONFIG, windows)
    figure.draw_without_rendering()
    return np.reshape(figure.axes[:6], (2, 3))


def test_camera_and_lidar_are_drawn_from_left_to_right(scanlines):
    # Names once for each row and each column.
    titles = [[ax.get_title() for ax in row] for row in scanlines]
    assert titles == [[*CONFIG.arena.classes], [""] * 3]
    names = [[ax.get_ylabel() for ax in row] for row in scanlines]
    assert names == [["camera", "", ""], ["lidar", "", ""]]
    heights = [ax.get_position().height for ax in scanlines[:, 0]]
    assert heights[0] < heights[1] / 3
    # The PoI is expected in the middle.
    for ax, number in zip(
        scanlines[:, 0], (CONFIG.camera.window, CONFIG.lidar.window), strict=True
    ):
        assert ax.lines[-1].get_xdata()[0] == (number - 1) / 2
        assert ax.get_xlim() == (-0.5, number - 0.5)
    row = scanlines[0, 0].images[0].get_array()[0]
    assert row.shape == (CONFIG.camera.window, 3)
    ranges = scanlines[1, 0].lines[0].get_ydata()
    for left, *_, right in (row[:, 0], ranges):
        assert left > right
    # All distances on one scale.
    for ax in scanlines[1]:
        assert ax.get_ylim() == (0.0, pytest.approx(1.05 * 0.8))


def test_plots_of_sixteen_classes_have_room_for_all(recwarn):
    shapes = {**SHAPES, "post": Shape("cylinder", (0.5, 0.5)), "slab": Shape("box", (1.0, 0.5))}
    paints = {"red": (0.8, 0.1, 0.1), "green": (0.1, 0.7, 0.1), "blue": (0.1, 0.1, 0.8)}
    paints["grey"] = (0.5, 0.5, 0.5)
    classes = tuple(f"{colour} {shape}" for colour in paints for shape in shapes)
    arena = ArenaConfig(shapes=shapes, colours=paints, classes=classes)
    config = replace(CONFIG, arena=arena, jmvae=replace(CONFIG.jmvae, latent_size=8))
    sizes = {sensor.name: (16, sensor.window, sensor.channels) for sensor in sensors.make(config)}
    windows = {name: np.full(size, 0.5) for name, size in sizes.items()}
    # The fourth dimension shows the colour and the seventh the shape; a sensor knows one of them.
    noise = 0.01 * np.random.default_rng(0).normal(size=(16, 9, 8))
    colour, shape = np.zeros((16, 1, 8)), np.zeros((16, 1, 8))
    colour[:, 0, 3], shape[:, 0, 6] = np.arange(16) // 4, np.arange(16) % 4
    means = {"joint": colour + shape, "camera": colour, "lidar": shape}
    of_all = {n: Belief(mean + noise, np.full((16, 9, 8), 0.3)) for n, mean in means.items()}
    first = scan_plots.scanlines(config, windows)
    for figure in (first, latent_plots.latent_space(config, of_all)):
        figure.draw_without_rendering()
        width, height = figure.get_size_inches()
        assert width < 16
        for ax in figure.axes:
            box = ax.get_position()
            assert box.width * width > 2.0
            assert box.height * height > (0.2 if figure is first else 2.0)
    names = [{text.get_text() for text in ax.texts} for ax in figure.axes[:3]]
    assert names == [set(classes), set(paints), set(shapes)]
    assert [ax.get_xlabel() for ax in figure.axes[:3]] == ["latent dimension 4"] * 3
    assert figure.axes[0].get_ylabel() == "latent dimension 7"
    assert not recwarn.list


def test_pixels_are_drawn_with_the_gamma_of_screens(scanlines):
    # 1.055 * 0.8^(1 / 2.4) - 0.055 = 0.9063 and 1.055 * 0.4^(1 / 2.4) - 0.055 = 0.6652
    row = np.asarray(scanlines[0, 0].images[0].get_array()[0])
    np.testing.assert_allclose(row[[0, -1]], [[0.9063] * 3, [0.6652] * 3], atol=1e-4)
    # Near black it is linear: 12.92 * 0.002 = 0.02584.
    np.testing.assert_allclose(colours.as_srgb(np.array([0.0, 0.002, 1.0])), [0, 0.02584, 1])


ARENAS = {
    "four alike": ArenaConfig(
        shapes={**SHAPES, "post": Shape("cylinder", (0.5, 0.5)), "slab": Shape("box", (1.0, 0.5))},
        classes=("red post", "red slab", "red cube", "red cylinder"),
    ),
    "two attributes": ArenaConfig(
        attributes={
            "temperature": Attribute({"cold": 30.0, "hot": 60.0}),
            "gloss": Attribute({"dull": 0.0, "shiny": 1.0}),
        },
        classes=tuple(
            f"{colour} {shape} {temperature} {gloss}"
            for colour in ("red", "green")
            for shape in ("cylinder", "cube")
            for temperature in ("cold", "hot")
            for gloss in ("dull", "shiny")
        ),
    ),
    "two names of black": ArenaConfig(
        colours={"black": (0.0, 0.0, 0.0), "jet": (0.001, 0.0, 0.0), "white": (1.0, 1.0, 1.0)},
        classes=("black cube", "jet cube", "black cylinder", "white cube", "white cylinder"),
    ),
}


@pytest.mark.parametrize("arena", ARENAS.values(), ids=ARENAS)
def test_every_class_has_a_colour_of_its_own(arena):
    rgb = np.array([colours.class_colour(arena, label) for label in arena.classes])
    assert (rgb >= 0).all()
    assert (rgb <= 1).all()
    apart = np.linalg.norm(rgb[:, None] - rgb[None], axis=-1)[np.triu_indices(len(rgb), 1)]
    assert apart.min() > 0.04  # 10 of 255


def test_a_class_is_drawn_in_the_colour_of_its_pois_or_else_darker():
    found = [colours.class_colour(CONFIG.arena, label) for label in CONFIG.arena.classes]
    np.testing.assert_allclose(found, [[0.1, 0.7, 0.1], [0.8, 0.1, 0.1], [0.4, 0.05, 0.05]])
