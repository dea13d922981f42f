"""The examples, as a user runs them; small, for most of their time is spent compiling."""

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
from jaxsense.dqn import policies
from jaxsense.dqn.episodes import reference
from jaxsense.run.rundir import RunDirectory, Settings
from jaxsense.training import learn, stages

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


def saved(path, config, models):
    with RunDirectory.create(path, Settings("smoke", 0, config)) as created:
        save_models(created, models)
    return path


@pytest.fixture(scope="module")
def run(config, tmp_path_factory):
    """The directory of a run with a thermal camera that has trained nothing."""
    models = jaxsense.init(jax.random.key(0), config)
    return saved(tmp_path_factory.mktemp("runs") / "thermal", config, models)


@pytest.fixture(scope="module")
def trained_run(config, learned, tmp_path_factory):
    """One of which only the Q-networks are not trained."""
    untrained = jaxsense.init(jax.random.key(0), config)
    q_networks = zip(config.modalities, untrained.q_networks, strict=True)
    models = stages.models(learned | {f"dqn_{name}": q for name, q in q_networks}, config)
    return saved(tmp_path_factory.mktemp("trained") / "thermal", config, models)


def trained(change, out: Path, *options: str) -> dict:
    train.main([*SMALL, "--out", str(out), "--cache", "None", *options], change)
    return json.loads((out / "summary.json").read_text())


@pytest.mark.slow  # compiles a whole run, as the next one does; before a release
def test_new_classes(example, tmp_path):
    # One of its two sensors, which compiles in half the time.
    change = example("new_classes").change
    lidar = ["--modalities", "lidar", "--jmvae.reconstruction-weights", "10"]
    summary = trained(change, tmp_path / "classes", *lidar)
    assert summary["detectors"]["lidar"]["accuracy"] >= 0.8
    assert len(summary["jmvae"]["sigma_norm"]["lidar"]) == 4
    config, _ = jaxsense.load(tmp_path / "classes")
    assert config == train.parse([*SMALL, *lidar], change).config
    assert config.labels("camera") == ("blue", "orange")


@pytest.mark.slow
def test_the_thermal_camera_tells_what_is_hot(learned):
    assert learned["detector_metrics"]["thermal"]["accuracy"] >= 0.95
    _, latent = learned["latent_space"]
    # Only what is hot is told by the thermal camera alone.
    thermal = np.asarray(latent.sigma_norm["thermal"])
    assert thermal[3] < 0.7 * min(thermal[:3])


@pytest.mark.slow
def test_recorded_scans(example, trained_run, tmp_path, capsys):
    recording = tmp_path / "recorded"  # without an ending

    def recorded_scans(*argv):
        example("recorded_scans").main([str(trained_run), *map(str, argv), "--trust"])
        return capsys.readouterr().out

    assert recorded_scans(recording, "--simulate") == ""
    assert [*tmp_path.iterdir()] == [recording]
    whole = recorded_scans(recording)
    recorded = dict(np.load(recording))
    assert recorded["lidar_scans"].shape == (4, 683)
    assert recorded["thermal_scans"].shape == (4, 64)
    assert whole.count("The map says:") == 4
    assert re.search(r"The map says: .*red cube hot \d\.\d\d", whole.splitlines()[-1])
    # Of the 683 rays of the run, 401 over 141 degrees.
    angles = sim.sensors.lidar(PRESETS["smoke"].lidar).angles[141:542].astype(float)
    narrow = {"lidar_scans": recorded["lidar_scans"][:, 141:542], "lidar_angles": angles}
    np.savez(tmp_path / "narrow.npz", **{**recorded, **narrow})
    assert recorded_scans(tmp_path / "narrow.npz") == whole
    # Another recording says something else: a PoI that is hot, and one that is not there.
    cold, hot = recorded["thermal_scans"][[0, 3]]
    torn = np.where(np.arange(64) == 32, np.nan, cold)
    changed = {
        "thermal_scans": np.stack([cold, hot, np.full(64, 20.0), torn]),
        "thermal_poses": recorded["thermal_poses"][[0, 3, 0, 0]],
        "places": recorded["places"][[0, 3, 0, 0]],
    }
    np.savez(tmp_path / "changed.npz", **{**recorded, **changed})
    told = re.findall(r"thermal: (.*)", recorded_scans(tmp_path / "changed.npz"))
    assert re.match(r"cold (0.9|1.0)", told[0])
    assert re.search(r"hot (0.9|1.0)", told[1])
    assert told[2] == "nothing there"
    assert told[3].startswith("outside of what was recorded or learned")


@pytest.mark.parametrize("is_there", [True, False])
def test_recorded_scans_neither_invents_nor_replaces_a_recording(example, run, tmp_path, is_there):
    recording = tmp_path / "recorded.npz"
    if is_there:
        recording.write_bytes(b"precious")
    argv = [str(run), str(recording), "--trust", *["--simulate"] * is_there]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(example("recorded_scans"), "simulate", lambda config: {})
        with pytest.raises(SystemExit, match=r"^recorded_scans: .*recorded\.npz") as stop:
            example("recorded_scans").main(argv)
    assert "\n" not in str(stop.value)
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"precious"] * is_there


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


def test_a_run_whose_sensor_cannot_be_imported_is_named(run, capsys, monkeypatch):
    monkeypatch.delitem(sys.modules, "new_modality", raising=False)
    assert importlib.util.find_spec("new_modality") is None
    with pytest.raises(SystemExit) as stop:
        evaluate.main([str(run), "--trust"])
    assert stop.value.code == 2
    assert "sensors.thermal.make = 'new_modality:thermal': must be" in capsys.readouterr().err


def test_three_sensors_fit_together(example):
    # The whole of it is what `python examples/new_modality.py` trains.
    config = example("new_modality").change(PRESETS["default"])
    shape = jaxsense.make_jmvae(config)
    assert shape.modalities == ("camera", "lidar", "thermal")
    assert shape.feature_sizes == (2, 2, 2)
