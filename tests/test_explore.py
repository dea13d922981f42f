"""`jaxsense explore`: missions in unknown places, their figures and their picture."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from smoke import error_line

from jaxsense import exploration, explore, load_pretrained, mission
from jaxsense.dqn.agent import Agent
from jaxsense.exploration.slots import Gospa
from jaxsense.show import plots
from jaxsense.summary import make
from jaxsense.summary.blocks import FOUND


def among_walls(config):
    arena = dataclasses.replace(config.arena, num_pois=3, fewest_pois=2, inner_walls=1)
    return dataclasses.replace(config, arena=arena)


SMALL = ["--arena.side", "4", "--arena.num-pois", "3"]


def test_figures_of_two_missions_by_hand():
    # Four PoIs and then one; three found, two of them right, one false, one slot in doubt.
    nothing, two = np.zeros(2), np.array([0.4, 0.2])
    gospa = Gospa(two, nothing, nothing, nothing, np.array([1, 0]), nothing, nothing)
    metrics = {
        "gospa": gospa,
        "off": np.array([[0.01, 0.03, np.nan, np.nan], [0.02, *[np.nan] * 3]]),
        "existence": np.array([[0.9, 0.9, 0.8, np.nan], [0.9, 0.5, np.nan, np.nan]]),
        "is_object": np.array([[True, True, False, False], [True, False, False, False]]),
        "present": np.array([4, 1]),
        "found": np.array([2, 1]),
        "false": np.array([1, 0]),
        "right": np.array([1, 1]),
        "confidence": np.array([1.5, 0.9]),
        "overflow": np.array([0, 2]),
        "time_s": np.array([60.0, 600.0]),
        "looks": np.array([7, 3]),
        "collisions": np.array([0, 0]),
    }
    late = make.found(metrics, {"time_s": np.array([100.0, 600.0])}, [0.2], 600.0)
    assert late["time_over_known"] is None
    block = make.found(metrics, {"time_s": np.array([100.0, 120.0])}, [0.2, 0.4], 600.0)
    assert block["found"] == pytest.approx(3 / 5)
    assert block["false"] == block["duplicates"] == pytest.approx(1 / 5)
    assert block["right"] == pytest.approx(2 / 3)
    assert block["confidence"] == pytest.approx(0.8)
    assert block["position_error"]["median"] == pytest.approx(0.02)
    assert block["time_over_known"] == pytest.approx(3.0)
    assert (block["late"], block["observations_per_poi"], block["overflow"]) == (0.5, 2.0, 2)
    assert block["existence"]["calibration"] == pytest.approx(4 / 5 - 3 / 5)
    nll = -(3 * np.log(0.9) + np.log(0.2) + np.log(0.5)) / 5
    assert block["existence"]["nll"] == pytest.approx(nll)
    assert block["gospa"]["total"] == pytest.approx(0.3)
    assert block["found_and_right"] == [0.2, 0.4]
    assert all(metric.value(block) is not None for metric in FOUND.values())
    assert {key.partition(".")[0] for key in FOUND} == set(block)


def test_the_picture_shows_what_robots_know_before_what_is_there():
    config, models = load_pretrained("default")
    config = among_walls(config)
    scenario = mission.make_mission(config)
    begun = jax.jit(exploration.reset, static_argnums=1)(jax.random.key(0), scenario, models)
    states = [begun, exploration.told(scenario, begun)]
    figure = plots.explored(config, models.fusion, jax.tree.map(np.asarray, states))
    unknown, known = (np.asarray(ax.images[0].get_array()) for ax in figure.axes)
    assert np.ptp(unknown) == 0
    walls = np.asarray(states[1].grid.occupied).T
    assert known[walls].max() < unknown.max() < known[~walls].min()
    number = int(begun.scene.layout.present.sum())
    assert [len(ax.patches) for ax in figure.axes] == [0, number]


@pytest.mark.parametrize(
    ("argv", "error"),
    [
        (["--policy", "best"], "policy = 'best': must be one of latent"),
        (["--episodes", "0"], "episodes = 0: must be a whole number, from 1 to 8,192"),
        (["--arena.fewest-pois", "13"], "arena.fewest_pois = 13"),
        (["--robots", "camera", "camera"], "robots = ('camera', 'camera')"),
        (["--arena.num-pois", "0"], "arena.num_pois = 0"),
        (["--robots", "sonar"], "robots = ('sonar',)"),
        (["no/such/run"], "no/such/run"),
        (["--out", "full"], "out = 'full': is not empty; must be a new or empty directory"),
    ],
)
def test_what_cannot_be_explored_is_refused_and_changes_nothing(
    tmp_path, monkeypatch, capsys, argv, error
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "file").write_text("precious")
    assert error in error_line(["--cache", "none", *argv], capsys, explore)
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["file", "full"]


def test_a_network_for_a_fixed_number_of_pois_plays_no_policy():
    config, models = load_pretrained("default")
    dense = dataclasses.replace(models, agent=Agent(0.5, 0.0, None, 3, 2, 2, (4,)))
    assert [*explore._playable(models.agent, config)] == [*exploration.POLICIES]
    playable = explore._playable(dense.agent, config)
    assert [*playable] == [name for name in exploration.POLICIES if name != "latent"]
    # The others do not ask the network.
    play = explore.Explorations(among_walls(config), dense, playable, 2, 0)
    jax.eval_shape(
        play._go_on, jnp.int32(0), jax.random.key(0), jax.eval_shape(lambda: play._begun)
    )


@pytest.mark.slow  # compiles missions
def test_missions_end_in_figures_and_pictures(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    errs = ["--localisation.error", ".01", "1"]
    explore.main([*SMALL, *errs, "--episodes", "2", "--time-limit", "150", "--out", "here"])
    content = json.loads((tmp_path / "here" / "found.json").read_text())
    found, arena = content["found"], content["arena"]
    assert content["robots"] == ["camera", "lidar"]
    assert content["localisation"] == {"error": [0.01, 1.0], "drift": [0.0, 0.0]}
    assert arena == {"side": 4.0, "num_pois": 3, "fewest_pois": 3, "inner_walls": 5}
    assert [*found] == [*exploration.POLICIES]
    for name, block in found.items():
        assert block["found"] >= 5 / 6
        assert block["episodes"] == 2
        assert block["found_and_right"][-1] == pytest.approx(block["found"] * block["right"])
        assert 0.5 < block["time_over_known"] < 10
        assert (tmp_path / "here" / f"explored-{name}.svg").stat().st_size > 1_000
    out = capsys.readouterr().out
    assert "2 missions of each policy" in out
