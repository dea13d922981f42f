"""The examples, as a user runs them; small, for most of their time is spent compiling."""

import importlib.util
import json
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
from jaxsense.stages import learn

import jaxsense
from jaxsense import evaluate, sim, stages, train
from jaxsense.config import PRESETS
from jaxsense.run.rundir import RunDirectory, Settings

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
def learned():
    """Settings with a thermal camera, what was learnt of the sensors, and what it is worth."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(EXAMPLES)
        change = importlib.import_module("new_modality").change
        config = train.parse([*SMALL, *THERMAL], change).config
        world = sim.make_world(config)

    perceive = jax.jit(lambda key: learn(key, config, world, until="look_values").outputs)
    return config, perceive(jax.random.key(0))


@pytest.fixture(scope="module")
def runs(learned, tmp_path_factory):
    """A directory with a run `thermal`, whose Q-networks are not trained."""
    config, outputs = learned
    untrained = jaxsense.init(jax.random.key(0), config)
    q_networks = zip(config.modalities, untrained.q_networks, strict=True)
    models = stages.models(outputs | {f"dqn_{name}": q for name, q in q_networks}, config)
    path = tmp_path_factory.mktemp("runs")
    with RunDirectory.create(path / "thermal", Settings("smoke", 0, config)) as created:
        created.save_models(models)
    return path


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


def test_the_thermal_camera_tells_what_is_hot(learned):
    _, outputs = learned
    assert outputs["detections"].metrics["thermal"]["accuracy"] >= 0.95
    _, latent = outputs["latent_space"]
    # Only what is hot is told by the thermal camera alone.
    thermal = np.asarray(latent["sigma_norm"]["thermal"])
    assert thermal[3] < 0.7 * min(thermal[:3])


def test_recorded_scans(example, runs, tmp_path, capsys):
    main, recording = example("recorded_scans").main, tmp_path / "recorded.npz"
    main(runs / "thermal", recording, trust=True)
    told = capsys.readouterr().out
    recorded = np.load(recording)
    assert recorded["lidar_scans"].shape == (4, 683)
    assert recorded["thermal_scans"].shape == (4, 64)
    assert told.count("The map says:") == 4
    assert told.rstrip().endswith("The map says: red cube hot")
    # Now the file is there, and is read.
    np.savez(recording, **{**recorded, "thermal_scans": np.full((4, 64), 60.0)})
    main(runs / "thermal", recording, trust=True)
    assert capsys.readouterr().out.count("thermal: cold 0.00, hot 1.00") == 4


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
