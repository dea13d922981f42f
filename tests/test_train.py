"""The command `train`, run as a user runs it: in-process, with the smoke preset."""

import dataclasses
import json
from pathlib import Path
from types import SimpleNamespace
from xml.etree import ElementTree

import jax
import numpy as np
import pytest
from matplotlib.figure import Figure
from same_figures import different_across_compilers
from smoke import MISSION_KEYS, SMOKE, error_line, without_times
from untrained import blank

import jaxsense
from jaxsense import train
from jaxsense.config import PRESETS
from jaxsense.show import drawing
from jaxsense.summary.read import read_summary


def test_run_directory_holds_everything(smoke_run):
    names = {path.name for path in smoke_run.iterdir()} | {".lock"}  # which may be gone
    names_of_plots = "latent_space", "reward", "scanlines", "calibration", "policies"
    plots = {f"{name}.svg" for name in names_of_plots}
    others = {"config.json", "metrics.jsonl", "origins.json", "summary.json", "checkpoints"}
    films = {"mission.svg", "mission-naive.svg"}
    assert names == {*others, *plots, *films, "report.html", ".lock"}
    for picture in plots | films:
        assert ElementTree.parse(smoke_run / picture).getroot().tag.endswith("svg")
    stages = {json.loads(line)["stage"] for line in (smoke_run / "metrics.jsonl").open()}
    assert {"detector_camera", "detector_lidar", "jmvae_1", "dqn_camera", "dqn_lidar"} <= stages


def test_summary_keeps_its_contract(smoke_run):
    found = read_summary(smoke_run)  # its types
    reference = json.loads((Path(__file__).parent / "smoke_figures.json").read_text("utf-8"))
    same = without_times(smoke_run)
    assert not different_across_compilers(same, reference)
    assert all(set(same["dqn"][name]) == set(block) for name, block in reference["dqn"].items())
    assert (found["preset"], found["seed"]) == ("smoke", 5)
    for block in found["dqn"].values():
        assert block["num_states"] == 384
        assert block["env_steps"] == 60 * 32  # epochs x environments of the smoke preset
        # With so little training there may be no optimum, and the policies are far from it.
        of_optimum = [block[x] for x in ("optimal", "fraction_of_optimal", "optimal_states")]
        if None in of_optimum:
            assert of_optimum == [None] * 3
        else:
            assert block["fraction_of_optimal"] == pytest.approx(block["return"] / block["optimal"])
            assert block["optimal_states"] < 384
    assert set(found["mission"]) == {"latent", "naive", "random"}
    for name, case in found["mission"].items():
        assert set(case) == MISSION_KEYS | ({"intervals"} if name != "latent" else set())
        assert case["episodes"] == sum(case["ended"].values()) == 4
        assert case["collisions"] == 0


def test_the_film_is_named_after_the_policy_that_it_shows(monkeypatch):
    first = dataclasses.replace(PRESETS["smoke"].mission, policies=("naive_2", "latent"))
    config, drawn = dataclasses.replace(PRESETS["smoke"], mission=first), []
    draw = lambda config, missions, *_: drawn.append(missions) or [""] * len(missions)  # noqa: E731
    monkeypatch.setattr(drawing.film, "draw", draw)
    monkeypatch.setattr(drawing.plots, "policies", lambda block: Figure())
    learned = SimpleNamespace(models=SimpleNamespace(fusion=None))
    own = {"naive_2": "own"}
    films = ["mission.svg", "mission-naive.svg"]
    for recordings in (own, {**own, "naive": "other"}):
        played = SimpleNamespace(recordings=recordings)
        found = drawing.of_missions(config, learned, played, {})  # pyright: ignore
        assert [*found] == ["policies.svg", *films[: len(recordings)]]
    own = {"naive_2 policy": "own"}
    assert drawn == [own, {**own, "naive policy": "other"}]


def test_a_finished_run_is_loaded_with_its_settings(smoke_run):
    config, models = jaxsense.load(smoke_run)
    assert config == PRESETS["smoke"]
    new = blank(config)
    assert jax.tree.structure(models) == jax.tree.structure(new)
    kernel = models.jmvae["encoders"]["camera"]["params"]["Dense_0"]["kernel"]
    assert np.isfinite(kernel).all()
    assert not np.array_equal(
        kernel, new.jmvae["encoders"]["camera"]["params"]["Dense_0"]["kernel"]
    )


@pytest.mark.slow  # compiles a whole run of its own; before a release
def test_a_run_with_a_filter_trains_plays_and_is_loaded(tmp_path, cache):
    path = tmp_path / "run"
    options = "--jmvae.fusion", "filter", "--mdp.reward", "nats", "--mission.episodes", "16"
    train.main([*SMOKE, *cache, *options, "--out", str(path)])
    found = read_summary(path)
    # The filter is hardly trained, but adds up what the looks show.
    assert found["belief"]["accuracy"][-1] > found["belief"]["accuracy"][0] + 0.1
    # The Q-networks have learned too little to say when to stop; naive exploration sees everything.
    assert found["mission"]["naive"]["accuracy"] > found["mission"]["random"]["accuracy"]
    config, models = jaxsense.load(path)
    assert (config.jmvae.fusion, config.mdp.reward) == ("filter", "nats")
    np.testing.assert_allclose(models.fusion.prior.std, [20**0.5] * 2, rtol=1e-6)


def test_another_run_is_never_overwritten(smoke_run, capsys):
    before = {path: path.stat().st_mtime_ns for path in smoke_run.rglob("*")}
    line = error_line([*SMOKE, "--out", str(smoke_run)], capsys)
    assert f"out = {str(smoke_run)!r}: is not empty; must be a new or empty directory" in line
    assert {path: path.stat().st_mtime_ns for path in smoke_run.rglob("*")} == before


@pytest.mark.slow
def test_what_a_run_cannot_learn_is_told(cache, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(train, "beyond_training", lambda config: ["9 PoIs: too many"])
    train.main([*SMOKE, *cache, "--out", str(tmp_path / "run"), "--mdp.min-increase", "50"])
    told = ["9 PoIs: too many", "no look pays: lower what it costs, or mdp.min_increase"]
    assert capsys.readouterr().err.splitlines() == [f"jaxsense.train: {line}" for line in told]
