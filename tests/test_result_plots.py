"""The plots of learning and of missions say what is in them."""

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.colors import to_rgb

from jaxsense.config import PRESETS
from jaxsense.dqn import POLICIES
from jaxsense.show import colours, drawing, learning_plots, mission_plots
from jaxsense.training.measures import reliability

CONFIG = PRESETS["smoke"]
LIDAR = replace(
    CONFIG, modalities=("lidar",), jmvae=replace(CONFIG.jmvae, reconstruction_weights=(1.0,))
)
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
    names = [*POLICIES, "my own"]
    for each in (colours.policy_colour, colours.policy_marker):
        assert len({each(name) for name in names}) == len(names)
    light = [colours.policy_colour(name) for name in names]
    for page in (light, [drawing.on_dark(colour) for colour in light]):
        seen = [lab(colour, sight) for colour in page]
        apart = np.linalg.norm(np.subtract.outer(seen, seen).diagonal(axis1=1, axis2=3), axis=-1)
        # Some five times what can be noticed.
        assert apart[np.triu_indices(len(seen), 1)].min() > 13


def test_curves_that_belong_to_no_policy_differ_as_policies_do():
    styles = [colours.series(number) for number in range(len(POLICIES))]
    assert len({style["color"] for style in styles}) == len(styles)
    assert len({style["marker"] for style in styles}) == len(styles)
    assert colours.series(len(POLICIES)) == styles[0]


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
