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
from smoke import error_line, written_run
from untrained import blank, untrained

import jaxsense
from jaxsense import Belief, evaluate, train
from jaxsense.config import PRESETS
from jaxsense.dqn import policies
from jaxsense.dqn.episodes import reference

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
    assert config == train.parse([*SMALL, *lidar], change).settings.config
    assert config.labels("camera") == ("blue", "orange")


def printed(name, capsys):
    """What an example prints."""
    runpy.run_path(str(EXAMPLES / f"{name}.py"), run_name="__main__")
    return capsys.readouterr().out


def test_the_optimum_of_a_product_of_experts_is_that_of_looks_which_add_up(example, monkeypatch):
    config, key = PRESETS["smoke"], jax.random.key(0)
    models = example("new_fusion").multiplying(untrained(config))
    mdp = jaxsense.make_mdp(config, models)
    monkeypatch.setitem(policies.UNORDERED, "optimal", lambda *_: "dynamic programming")
    found = reference(key, mdp, models, models.bayes.labels)
    assert found(None, None) == "dynamic programming"


@pytest.mark.slow
def test_new_policy(capsys):
    told = printed("new_policy", capsys)
    assert re.search(r"one robot: total reward -?\d+\.\d\d, of the first look -?\d+\.\d\d", told)
    rows = re.findall(r"^(\w+) +[01]\.\d{3} +\d+\.\d\d +\d+\.\d ", told, re.MULTILINE)
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


def test_a_run_whose_sensor_cannot_be_imported_is_named(tmp_path, capsys, monkeypatch):
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(EXAMPLES)
        change = importlib.import_module("new_modality").change
        config = train.parse([*SMALL, *THERMAL], change).settings.config
        run = written_run(tmp_path / "run", config, blank(config))
    monkeypatch.delitem(sys.modules, "new_modality")
    line = error_line([str(run), "--trust"], capsys, evaluate)
    assert "sensors.thermal.make = 'new_modality:thermal': must be" in line
