"""The plots of a run say what is in them."""

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.collections import PatchCollection, PathCollection
from matplotlib.colors import to_rgb

from jaxsense.config import PRESETS, SHAPES, ArenaConfig, Attribute, Shape
from jaxsense.core.types import Belief
from jaxsense.dqn import POLICIES
from jaxsense.show import colours, latent_plots, learning_plots, mission_plots, scan_plots
from jaxsense.sim import sensors
from jaxsense.training.measures import reliability

CONFIG = PRESETS["smoke"]
LIDAR = replace(
    CONFIG, modalities=("lidar",), jmvae=replace(CONFIG.jmvae, reconstruction_weights=(1.0,))
)
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


CURVES = {"reward": np.arange(40.0), "evaluation": np.full(40, np.nan)}
CURVES["evaluation"][[9, 19, 29, 39]] = [1.0, 2.0, 3.0, 4.0]
AGENT = {"return": 4.0, "optimal": 4.5, "naive": 3.0, "random": -1.0}


def test_the_evaluation_is_drawn_where_it_was_played():
    figure = learning_plots.rewards({"camera": CURVES}, {"camera": AGENT})
    lines = {line.get_label(): line for line in figure.axes[0].lines}
    np.testing.assert_array_equal(lines["without exploration"].get_xdata(), [9, 19, 29, 39])
    np.testing.assert_array_equal(lines["without exploration"].get_ydata(), [1, 2, 3, 4])
    # The mean of the last 20 epochs, from 20 to 39.
    assert lines["exploring"].get_ydata()[-1] == 29.5
    assert lines["optimal"].get_ydata()[0] == 4.5
    # The axis begins as far below naive exploration as the optimum is above; a text has the rest.
    assert figure.axes[0].get_ylim()[0] == 1.5
    names = {text.get_text() for text in figure.axes[0].texts}
    others = {"exploring", "without exploration", "optimal", "naive"}
    assert names == {*others, "random: -1.00, below"}
    assert not figure.axes[0].get_legend()
    # A bad policy is shown too: .5 below it.
    bad = {"return": -2.0, "optimal": 3.0, "naive": 3.0, "random": -1.0}
    axes = learning_plots.rewards({"camera": CURVES}, {"camera": bad}).axes[0]
    assert axes.get_ylim()[0] == -2.5
    assert "random" in {text.get_text() for text in axes.texts}
    # Robots alone on the map share an axis.
    both = learning_plots.rewards(
        {"camera": CURVES, "lidar": CURVES}, {"camera": AGENT, "lidar": bad}
    )
    one, other = (ax.get_ylim() for ax in both.axes)
    assert one == other
    assert one[0] == -2.5


def test_episodes_of_a_team_are_not_drawn_beside_those_of_a_robot_alone():
    figure = learning_plots.rewards(
        {"team": CURVES}, {"camera": AGENT, "lidar": {**AGENT, "optimal": 9.0}}
    )
    of_team, alone = ({line.get_label() for line in ax.lines} for ax in figure.axes)
    assert of_team == {"exploring"}
    assert alone == {"without exploration", "optimal", "naive", "random"}
    assert figure.axes[1].get_title() == "team: one camera robot alone on the map"
    (optimal,) = (line for line in figure.axes[1].lines if line.get_label() == "optimal")
    assert optimal.get_ydata()[0] == 4.5


def test_curves_of_several_seeds_have_a_band():
    two = {kind: np.stack([values, values + 2]) for kind, values in CURVES.items()}
    axes = learning_plots.rewards({"camera": two}, {"camera": AGENT}).axes[0]
    lines = {line.get_label(): line for line in axes.lines}
    np.testing.assert_array_equal(lines["without exploration"].get_ydata(), [2, 3, 4, 5])
    assert len(axes.collections) == 2
    nothing = {kind: np.zeros((0, 40)) for kind in CURVES}
    learning_plots.rewards({"camera": nothing}, {"camera": AGENT}).draw_without_rendering()


def test_policies_stand_in_rows_by_their_time():
    def case(accuracy, looks, seconds, **more):
        of_case = {"accuracy": accuracy, "observations_per_poi": looks, "mean_time_s": seconds}
        return {**of_case, "episodes": 128, **more}

    slower = {"mean": 15.0, "low": 12.0, "high": 18.0}
    more = {"mean": 3.5, "low": 3.0, "high": 4.0}
    block = {
        "latent": case(0.98, 2.5, 40.0),
        "naive_3": case(1.0, 6.0, 55.0, intervals={"observations_per_poi": more, "time_s": slower}),
        "random": case(0.5, 1.0, 20.0),
        "camera_alone": case(0.5, 1.0, 20.0),
        "bytes_per_detection": {"latent": 16, "raw": 2000},
    }
    by_looks, by_time = mission_plots.policies(block, 3).axes
    names = [label.get_text() for label in by_looks.get_yticklabels()]
    assert names == ["naive_3", "latent", "random"]  # upwards
    wrong = [text.get_text() for text in by_time.texts]
    # Of 3 PoIs in 128 missions; .05^(1 / 384) = .9922, below which no wrong one would be luck.
    assert wrong == [
        "0 of 384 PoIs wrong (at most 0.78 %)",
        "8 of 384 PoIs wrong (2.1 %)",
        "192 of 384 PoIs wrong (50.0 %)",
    ]
    assert by_looks.lines[0].get_xdata() == [6.0]
    # A bar for the difference of naive exploration from the latent policy, around its own value.
    (bar,) = by_time.collections
    ((low, high),) = bar.get_segments()
    assert (low.tolist(), high.tolist()) == ([52.0, 0.0], [58.0, 0.0])


def test_of_several_seeds_the_bars_are_those_of_the_means():
    value = {"mean": 2.0, "low": 1.5, "high": 2.5}
    keys = "accuracy", "observations_per_poi", "mean_time_s"
    accuracy = {"mean": 0.98, "low": 0.97, "high": 1.01}
    of_seeds = {**{key: value for key in keys}, "accuracy": accuracy}
    ax, by_time = mission_plots.policies({"latent": of_seeds}, 3).axes
    ((low, high),) = ax.collections[0].get_segments()
    assert (low[0], high[0]) == (1.5, 2.5)
    assert by_time.texts[0].get_text() == "2.0 % of PoIs wrong (0.0 to 3.0)"
    alone = {**of_seeds, "accuracy": {"mean": 0.98, "low": None, "high": None}}
    _, by_time = mission_plots.policies({"latent": alone}, 3).axes
    assert by_time.texts[0].get_text() == "2.0 % of PoIs wrong"


# Linear RGB as those see it who lack one kind of cones (Machado et al. 2009).
SIGHTS = {
    "all cones": np.eye(3),
    "no red": [[0.1523, 1.0526, -0.2049], [0.1145, 0.7863, 0.0992], [-0.0039, -0.0481, 1.0520]],
    "no green": [[0.3673, 0.8606, -0.2280], [0.2801, 0.6725, 0.0474], [-0.0118, 0.0429, 0.9690]],
}


def lab(colour, sight):
    """CIE L*a*b* of a colour, as it is seen."""
    rgb = np.array(to_rgb(colour))
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    seen = np.clip(np.array(sight) @ linear, 0, 1)
    to_xyz = [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]
    x, y, z = np.cbrt(np.array(to_xyz) @ seen / [0.9505, 1.0, 1.089])
    return np.array([116 * y - 16, 500 * (x - y), 200 * (y - z)])


@pytest.mark.parametrize("sight", SIGHTS.values(), ids=SIGHTS)
def test_a_policy_has_one_colour_and_marker_that_all_can_tell_apart(sight):
    for each in (colours.policy_colour, colours.policy_marker):
        assert len({each(name) for name in [*POLICIES, "my own"]}) == len(POLICIES) + 1
    grey = {"naive", "naive_2", "naive_3", "random"}
    seen = [lab(colours.policy_colour(name), sight) for name in {*POLICIES} - grey]
    apart = np.linalg.norm(np.subtract.outer(seen, seen).diagonal(axis1=1, axis2=3), axis=-1)
    assert apart[np.triu_indices(len(seen), 1)].min() > 13  # some five times what can be noticed


def test_every_place_of_missions_stands_in_a_picture_of_times():
    def place(number, robots, seconds, side=CONFIG.arena.side, episodes=8):
        times = {"latent": seconds, "naive": seconds + 1}
        mission = {n: {"time_s": time, "episodes": episodes} for n, time in times.items()}
        return {"num_pois": number, "side": side, "robots": robots.split(), "mission": mission}

    places = [
        place(3, "camera lidar", 12.0),
        place(16, "camera camera lidar lidar", 45.0),
        place(8, "camera lidar", 36.0),
        place(8, "camera camera lidar lidar", 20.0),
        place(8, "camera camera lidar lidar", 99.0, episodes=7),  # in fewer arenas
        place(8, "lidar lidar lidar", 50.0, side=9.0),
    ]
    found = {
        ax.get_title(): np.transpose(ax.lines[0].get_data()).tolist()
        for ax in mission_plots.teams(places).axes
        if ax.axison
    }
    # Relative to naive exploration, which takes a second longer everywhere.
    assert found == {
        "robots: 1 camera, 1 lidar": [[3, 12 / 13], [8, 36 / 37]],
        "robots: 2 camera, 2 lidar": [[8, 20 / 21], [16, 45 / 46]],
        "robots: 3 lidar": [[8, 50 / 51]],
        "8 PoIs in 3 m": [[2, 36 / 37], [4, 20 / 21]],
    }
    first = mission_plots.teams(places).axes[0]
    assert [label.get_text() for label in first.get_xticklabels()] == ["3\n13 s", "8\n37 s"]
    assert {text.get_text() for text in first.texts} == {"latent", "naive"}
    # An auction is a better reference, but it was not held everywhere.
    for each in places[:-1]:
        each["mission"]["auction"] = {"time_s": 10.0, "episodes": 8}
    assert "naive" in mission_plots.teams(places).axes[0].get_xlabel()
    places[-1]["mission"]["auction"] = {"time_s": 10.0, "episodes": 8}
    first = mission_plots.teams(places).axes[0]
    assert first.lines[0].get_ydata().tolist() == [1.2, 3.6]
    # Without any reference times are seconds.
    for each in places:
        each["mission"] = {"latent": each["mission"]["latent"]}
    assert mission_plots.teams(places).axes[0].lines[0].get_ydata().tolist() == [12.0, 36.0]


def test_a_detector_that_is_calibrated_lies_on_the_diagonal():
    # Of ten looks at a class, nine say so with .9, and one says the opposite.
    right, wrong = [0.9, 0.1], [0.1, 0.9]
    looks = np.array([[right] * 9 + [wrong], [right] * 9 + [wrong], [wrong] * 9 + [right]])
    belief = {"looks": [1, 2], "nll": [0.5, 0.2], "bayes_nll": [0.4, 0.1]}
    detectors, beliefs = learning_plots.calibration(
        CONFIG, reliability(LIDAR, (looks,)), belief
    ).axes
    # A bin of fewer than twenty looks, six with .8, is left out.
    looks = np.concatenate([looks, np.tile([0.8, 0.2], (3, 2, 1))], axis=1)
    detectors, _ = learning_plots.calibration(CONFIG, reliability(LIDAR, (looks,)), belief).axes
    confidence, accuracy = detectors.lines[1].get_data()
    np.testing.assert_allclose(confidence[np.isfinite(confidence)], [0.9], rtol=1e-6)
    np.testing.assert_allclose(accuracy[np.isfinite(accuracy)], [0.9], rtol=1e-6)
    # All of them say nine tenths, which a single circle does not tell.
    assert detectors.lines[1].get_label() == "lidar: 83 % at 0.900"
    assert [line.get_label() for line in beliefs.lines] == ["map", "exact Bayes"]
    np.testing.assert_array_equal(beliefs.lines[0].get_ydata(), [0.5, 0.2])
