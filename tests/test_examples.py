"""The examples, as a user runs them; small, for most of their time is spent compiling."""

import dataclasses
import importlib.util
import json
import re
import runpy
import sys
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from smoke import save_models

import jaxsense
from jaxsense import Belief, evaluate, sim, train
from jaxsense.config import PRESETS
from jaxsense.core.types import pytree
from jaxsense.dqn import policies
from jaxsense.dqn.reference import reference
from jaxsense.run.rundir import RunDirectory, Settings
from jaxsense.training import learn, stages
from jaxsense.vae import InPlace

SMALL = ("--preset", "smoke", "--mission.episodes", "1")
THERMAL = (
    *("--modalities", "lidar", "thermal"),
    *("--jmvae.reconstruction-weights", "10", "10"),
)
EXAMPLES = Path(__file__).parent.parent / "examples"


@pytest.fixture
def example(monkeypatch):
    """Imports an example, from where others can import it by its name as well."""
    monkeypatch.syspath_prepend(EXAMPLES)
    return importlib.import_module


@pytest.fixture(scope="module")
def config():
    """Settings with a thermal camera."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(EXAMPLES)
        change = importlib.import_module("new_modality").change
        return train.parse([*SMALL, *THERMAL], change).config


@pytest.fixture(scope="module")
def learned(config):
    """What was learnt of the sensors, and what it is worth."""
    arena = sim.make_world(config).arena
    perceive = jax.jit(lambda key: learn(key, config, arena, until="look_values").outputs)
    return perceive(jax.random.key(0))


@pytest.fixture(scope="module")
def runs(config, tmp_path_factory):
    """A directory with a run `thermal` that has trained nothing."""
    path = tmp_path_factory.mktemp("runs")
    save(path / "thermal", config, jaxsense.init(jax.random.key(0), config))
    return path


@pytest.fixture(scope="module")
def trained_runs(config, learned, tmp_path_factory):
    """A directory with a run `thermal`, of which only the Q-networks are not trained."""
    untrained = jaxsense.init(jax.random.key(0), config)
    q_networks = zip(config.modalities, untrained.q_networks, strict=True)
    models = stages.models(learned | {f"dqn_{name}": q for name, q in q_networks}, config)
    path = tmp_path_factory.mktemp("trained")
    save(path / "thermal", config, models)
    return path


def save(path, config, models):
    with RunDirectory.create(path, Settings("smoke", 0, config)) as created:
        save_models(created, models)


def run(change, out: Path, *options: str) -> dict:
    train.main([*SMALL, "--out", str(out), "--cache", "None", *options], change)
    return json.loads((out / "summary.json").read_text())


@pytest.mark.slow  # compiles a whole run, as the next one does; before a release
def test_new_classes(example, tmp_path):
    # One of its two sensors, which compiles in half the time.
    change = example("new_classes").change
    lidar = ["--modalities", "lidar", "--jmvae.reconstruction-weights", "10"]
    summary = run(change, tmp_path / "classes", *lidar)
    assert summary["detectors"]["lidar"]["accuracy"] >= 0.8
    assert len(summary["jmvae"]["sigma_norm"]["lidar"]) == 4
    config, _ = jaxsense.load(tmp_path / "classes")
    assert config == train.parse([*SMALL, *lidar], change).config
    assert config.labels("camera") == ("blue", "orange")


@pytest.mark.slow
def test_new_modality(example, tmp_path):
    summary = run(example("new_modality").change, tmp_path / "thermal", *THERMAL)
    assert summary["detectors"]["thermal"]["accuracy"] >= 0.95
    assert set(summary["dqn"]) == {"lidar", "thermal"}


@pytest.mark.slow
def test_the_thermal_camera_tells_what_is_hot(learned):
    assert learned["detector_metrics"]["thermal"]["accuracy"] >= 0.95
    _, latent = learned["latent_space"]
    # Only what is hot is told by the thermal camera alone.
    thermal = np.asarray(latent.sigma_norm["thermal"])
    assert thermal[3] < 0.7 * min(thermal[:3])


def on_a_run(main, path):
    """Runs an example on the run, as from the command line."""
    return lambda *argv: main([str(path / "thermal"), *map(str, argv), "--trust"])


@pytest.fixture
def recorded_scans(example, runs):
    return on_a_run(example("recorded_scans").main, runs)


@pytest.fixture
def trained_recorded_scans(example, trained_runs):
    return on_a_run(example("recorded_scans").main, trained_runs)


@pytest.mark.slow
def test_recorded_scans(trained_recorded_scans, tmp_path, capsys):
    recorded_scans, recording = trained_recorded_scans, tmp_path / "recorded"  # without an ending
    recorded_scans(recording, "--simulate")
    assert capsys.readouterr().out == ""
    assert [*tmp_path.iterdir()] == [recording]
    recorded_scans(recording)
    told = capsys.readouterr().out
    recorded = np.load(recording)
    assert recorded["lidar_scans"].shape == (4, 683)
    assert recorded["thermal_scans"].shape == (4, 64)
    assert told.count("The map says:") == 4
    assert re.search(r"The map says: .*red cube hot \d\.\d\d", told.splitlines()[-1])
    # Another recording says something else: a PoI that is hot, and one that is not there.
    cold, hot = recorded["thermal_scans"][[0, 3]]
    poses = recorded["thermal_poses"][[0, 3, 0, 0]]
    changed = {**recorded, "thermal_scans": np.stack([cold, hot, np.full(64, 20.0), cold])}
    changed |= {"thermal_poses": poses, "places": recorded["places"][[0, 3, 0, 0]]}
    changed["thermal_scans"][3, 32] = np.nan
    np.savez(tmp_path / "changed.npz", **changed)
    recorded_scans(tmp_path / "changed.npz")
    told = re.findall(r"thermal: (.*)", capsys.readouterr().out)
    assert re.match(r"cold (0.9|1.0)", told[0])
    assert re.search(r"hot (0.9|1.0)", told[1])
    assert told[2] == "nothing there"
    assert told[3].startswith("outside of what was recorded or learned")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"places": None}, "places is missing; a recording holds places, lidar_poses, "),
        ({"thermal_scans": None}, "thermal_scans is missing"),
        ({"places": np.zeros((4, 3))}, "places has the shape (4, 3); must be (C, 2) for C places"),
        ({"places": np.float32(1)}, "places has the shape (); must be (C, 2)"),
        ({"lidar_poses": np.zeros((3, 3))}, "lidar_poses has the shape (3, 3); must be (C, 3)"),
        (
            {"lidar_scans": np.zeros((4, 600))},
            "lidar_scans has the shape (4, 600); must be (C, 683)",
        ),
        ({"lidar_scans": np.full((4, 683), "x")}, "lidar_scans must hold numbers, not <U1"),
    ],
)
def test_a_recording_that_does_not_fit_is_named_in_one_line(
    recorded_scans, tmp_path, changes, expected, capsys
):
    recorded = {"places": np.zeros((4, 2))}
    for name, rays in (("lidar", 683), ("thermal", 64)):
        recorded |= {f"{name}_poses": np.zeros((4, 3)), f"{name}_scans": np.zeros((4, rays))}
    recorded = {name: x for name, x in {**recorded, **changes}.items() if x is not None}
    np.savez(tmp_path / "recorded.npz", **recorded)
    with pytest.raises(SystemExit) as stop:
        recorded_scans(tmp_path / "recorded.npz")
    assert str(stop.value).startswith(f"recorded_scans: {expected}")
    assert "\n" not in str(stop.value)
    assert capsys.readouterr().out == ""


@pytest.mark.slow
@pytest.mark.parametrize("is_there", [True, False])
def test_recorded_scans_neither_invents_nor_replaces_a_recording(
    recorded_scans, tmp_path, is_there, capsys
):
    recording = tmp_path / "recorded.npz"
    if is_there:
        recording.write_bytes(b"precious")
    with pytest.raises(SystemExit, match=r"^recorded_scans: .*recorded\.npz") as stop:
        recorded_scans(recording, *["--simulate"] * is_there)
    assert "\n" not in str(stop.value)
    assert capsys.readouterr().out == ""
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"precious"] * is_there


@pytest.mark.slow
def test_recorded_scans_of_other_rays(trained_recorded_scans, tmp_path, capsys):
    recorded_scans = trained_recorded_scans
    recorded_scans(tmp_path / "recorded.npz", "--simulate")
    content = dict(np.load(tmp_path / "recorded.npz"))
    # Of the 683 rays of the run, 401 over 141 degrees.
    lidar = sim.sensors.lidar(PRESETS["smoke"].lidar)
    content |= {"lidar_scans": content["lidar_scans"][:, 141:542]}
    content |= {"lidar_angles": lidar.angles[141:542].astype(float)}
    np.savez(tmp_path / "narrow.npz", **content)
    recorded_scans(tmp_path / "recorded.npz")
    whole = capsys.readouterr().out
    recorded_scans(tmp_path / "narrow.npz")
    assert capsys.readouterr().out == whole
    content |= {"lidar_scans": content["lidar_scans"][:, :100]}
    content |= {"lidar_angles": content["lidar_angles"][:100]}
    np.savez(tmp_path / "too_narrow.npz", **content)
    expected = r"field of view of lidar = 34\.8 degrees: must be at least 44\.7"
    with pytest.raises(SystemExit, match=expected):
        recorded_scans(tmp_path / "too_narrow.npz")


def test_recorded_scans_names_missing_arguments(example, capsys):
    with pytest.raises(SystemExit) as stop:
        example("recorded_scans").main(["runs/smoke"])
    assert stop.value.code == 2
    assert capsys.readouterr().err.splitlines()[-1].endswith("arguments are required: recording")


@pytree
class Latest(InPlace):
    """Remembers only the modality of the last look."""

    def update(self, belief, seen, features, modality):
        return Belief(jnp.full_like(belief.mean, modality + 5.5), belief.std)


@pytest.mark.slow
def test_recorded_scans_uses_the_fusion_of_the_run(recorded_scans, tmp_path, monkeypatch, capsys):
    recorded_scans(tmp_path / "recorded.npz", "--simulate")
    load = jaxsense.load

    def with_another(run, trust):
        config, models = load(run, trust)
        parts = {p.name: getattr(models.fusion, p.name) for p in dataclasses.fields(InPlace)}
        return config, dataclasses.replace(models, fusion=Latest(**parts))

    monkeypatch.setattr(jaxsense, "load", with_another)
    recorded_scans(tmp_path / "recorded.npz")
    told = re.findall(r"in map: +mean \[(\S+)", capsys.readouterr().out)
    assert told == ["5.5", "6.5"] * 4


def test_own_values_take_at_most_forty_lines():
    for name in ("new_fusion", "new_modality", "new_policy", "new_reward"):
        assert len((EXAMPLES / f"{name}.py").read_text().splitlines()) <= 40


def printed(name, capsys):
    """What an example prints."""
    runpy.run_path(str(EXAMPLES / f"{name}.py"), run_name="__main__")
    return capsys.readouterr().out


@pytest.mark.slow  # compiles missions of all policies, as the next one does
def test_new_fusion(capsys):
    told = printed("new_fusion", capsys)
    norms = [
        np.linalg.norm(np.fromstring(sigma, sep=" "))
        for sigma in re.findall(r"sigma \[(.*?)\] after", told)
    ]
    # Each look makes the product narrower.
    assert len(norms) == 3
    assert norms[0] > norms[1] > norms[2]
    assert "looks in a mission" in told


def test_a_product_of_experts_is_the_fusion_of_the_mdp(example):
    config = PRESETS["smoke"]
    models = example("new_fusion").multiplying(jaxsense.init(jax.random.key(0), config))
    mdp = jaxsense.make_mdp(config, models)
    prior, features = mdp.fusion.prior, jnp.array([0.25, 0.75])
    once = mdp.fusion.update(prior, np.zeros(2, bool), features, 0)
    alone = mdp.fusion.together({0: features})
    # The first look is what it says alone: 1/prior + 1/alone - 1/prior.
    np.testing.assert_allclose(once.std, alone.std, rtol=1e-4)
    np.testing.assert_allclose(once.mean, alone.mean, rtol=1e-3, atol=1e-5)
    twice = mdp.fusion.update(once, np.ones(2, bool), features, 0)
    np.testing.assert_allclose(twice.std**-2, 2 * alone.std**-2 - prior.std**-2, rtol=1e-4)


def test_the_optimum_of_a_product_of_experts_is_that_of_looks_which_add_up(example, monkeypatch):
    config, key = PRESETS["smoke"], jax.random.key(0)
    models = example("new_fusion").multiplying(jaxsense.init(key, config))
    mdp = jaxsense.make_mdp(config, models)
    monkeypatch.setattr(policies, "optimal", lambda key, models, known: "dynamic programming")
    found = reference(key, mdp, 0, models, models.bayes.labels)
    assert found(None, None) == "dynamic programming"


@pytest.mark.slow
def test_new_policy(capsys):
    told = printed("new_policy", capsys)
    assert re.search(r"map MDP: total reward -?\d+\.\d\d, of the first look -?\d+\.\d\d", told)
    rows = re.findall(r"^  (\w+) +[01]\.\d{3} +\d+\.\d\d +\d+\.\d ", told, re.MULTILINE)
    assert rows == ["widest", "latent", "auction", "naive", "random"]


def test_the_widest_belief_is_looked_at_twice_at_most(example):
    widest = example("new_policy").widest
    belief = Belief(jnp.zeros((3, 2)), jnp.array([[3.0, 4.0], [0.6, 0.8], [1.2, 0.5]]))
    known = SimpleNamespace(belief=belief, looks=jnp.array([[2, 0], [0, 1], [1, 0]]), modality=0)
    np.testing.assert_allclose(widest(None, None, known), [-1.0, 1.0, 1.3, 0.0], rtol=1e-6)


@pytest.mark.slow  # compiles a training
def test_new_reward(capsys):
    with jax.debug_key_reuse(True):
        told = printed("new_reward", capsys)
    first, last = map(float, re.findall(r"-?\d+\.\d{3}", told))
    # It learns to look while looks add more than they cost, at most from 1/3 to 1 at each PoI.
    assert first + 0.1 < last < 3 * (1 - 1 / 3)


def test_a_run_whose_sensor_cannot_be_imported_is_named(runs, capsys, monkeypatch):
    monkeypatch.delitem(sys.modules, "new_modality", raising=False)
    assert importlib.util.find_spec("new_modality") is None
    with pytest.raises(SystemExit) as stop:
        evaluate.main([str(runs / "thermal"), "--trust"])
    assert stop.value.code == 2
    assert "sensors.thermal.make = 'new_modality:thermal': must be" in capsys.readouterr().err


def test_three_sensors_fit_together(example):
    # The whole of it is what `python examples/new_modality.py` trains.
    config = example("new_modality").change(PRESETS["default"])
    shape = jaxsense.make_jmvae(config)
    assert shape.modalities == ("camera", "lidar", "thermal")
    assert shape.feature_sizes == (2, 2, 2)
