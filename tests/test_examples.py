"""The examples, as a user runs them; small, for most of their time is spent compiling."""

import importlib.util
import json
import sys
from pathlib import Path

import numpy as np
import pytest

import jaxsense
from jaxsense import evaluate, train
from jaxsense.config import PRESETS

SMALL = ("--preset", "smoke", "--mission.episodes", "1")
EXAMPLES = Path(__file__).parent.parent / "examples"


@pytest.fixture
def example(monkeypatch):
    """Imports an example, from where others can import it by its name as well."""
    monkeypatch.syspath_prepend(EXAMPLES)
    return importlib.import_module


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    return tmp_path_factory.mktemp("runs")


def run(change, out: Path, *options: str) -> dict:
    train.main([*SMALL, "--out", str(out), "--cache", "None", *options], change)
    return json.loads((out / "summary.json").read_text())


@pytest.mark.slow  # compiles a whole run, as the next one does; before a release
def test_new_classes(example, runs):
    # One of its two sensors, which compiles in half the time.
    change = example("new_classes").change
    lidar = ["--modalities", "lidar", "--jmvae.reconstruction-weights", "10"]
    summary = run(change, runs / "classes", *lidar)
    assert summary["detectors"]["lidar"]["accuracy"] >= 0.8
    assert len(summary["jmvae"]["sigma_norm"]["lidar"]) == 4
    config, _ = jaxsense.load(runs / "classes")
    assert config == train.parse([*SMALL, *lidar], change).config
    assert config.labels("camera") == ("blue", "orange")


def test_new_modality(example, runs):
    two = ["--modalities", "lidar", "thermal", "--jmvae.reconstruction-weights", "10", "10"]
    summary = run(example("new_modality").change, runs / "thermal", *two)
    assert summary["detectors"]["thermal"]["accuracy"] >= 0.95
    assert set(summary["dqn"]) == {"lidar", "thermal"}
    # Only what is hot is told by the thermal camera alone.
    thermal = summary["jmvae"]["sigma_norm"]["thermal"]
    assert thermal[3] < 0.7 * min(thermal[:3])


def test_recorded_scans(example, runs, tmp_path, capsys):
    main, recording = example("recorded_scans").main, tmp_path / "recorded.npz"
    main(runs / "thermal", recording)
    told = capsys.readouterr().out
    recorded = np.load(recording)
    assert recorded["lidar_scans"].shape == (4, 683)
    assert recorded["thermal_scans"].shape == (4, 64)
    assert told.count("The map says:") == 4
    assert told.rstrip().endswith("The map says: red cube hot")
    # Now the file is there, and is read.
    np.savez(recording, **{**recorded, "thermal_scans": np.full((4, 64), 60.0)})
    main(runs / "thermal", recording)
    assert capsys.readouterr().out.count("thermal: cold 0.00, hot 1.00") == 4


def test_a_run_whose_sensor_cannot_be_imported_is_named(runs, capsys, monkeypatch):
    monkeypatch.delitem(sys.modules, "new_modality", raising=False)
    assert importlib.util.find_spec("new_modality") is None
    with pytest.raises(SystemExit) as stop:
        evaluate.main([str(runs / "thermal")])
    assert stop.value.code == 2
    assert "sensors.thermal.make = 'new_modality:thermal': must be" in capsys.readouterr().err


def test_three_sensors_fit_together(example):
    # The whole of it is what `python examples/new_modality.py` trains.
    config = example("new_modality").change(PRESETS["default"])
    shape = jaxsense.jmvae_shape(config)
    assert shape.modalities == ("camera", "lidar", "thermal")
    assert shape.feature_sizes == (2, 2, 2)
