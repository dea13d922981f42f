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

EXAMPLES = Path(__file__).parent.parent / "examples"


@pytest.fixture
def example(monkeypatch):
    """Imports an example, from where others can import it by its name as well."""
    monkeypatch.syspath_prepend(EXAMPLES)
    return importlib.import_module


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    return tmp_path_factory.mktemp("runs")


def run(example, out: Path, *options: str) -> dict:
    argv = ["--preset", "smoke", "--out", str(out), "--cache", "None", *options]
    train.main(argv, example.change)
    return json.loads((out / "summary.json").read_text())


def test_new_classes(example, runs):
    summary = run(example("new_classes"), runs / "classes", "--mission.episodes", "1")
    assert summary["detectors"]["camera"]["accuracy"] >= 0.99
    assert summary["detectors"]["lidar"]["accuracy"] >= 0.8
    assert all(len(norms) == 4 for norms in summary["jmvae"]["sigma_norm"].values())
    config, models = jaxsense.load(runs / "classes")
    assert (
        config
        == train.parse(
            ["--preset", "smoke", "--mission.episodes", "1"], example("new_classes").change
        ).config
    )


def test_recorded_scans(example, runs, tmp_path, capsys):
    main = example("recorded_scans").main
    main(runs / "classes", tmp_path / "recorded.npz")
    told = capsys.readouterr().out
    recorded = np.load(tmp_path / "recorded.npz")
    assert recorded["camera_scans"].shape == (4, 640, 3)
    assert recorded["lidar_scans"].shape == (4, 683)
    assert told.count("The map says:") == 4
    assert "The map says: blue cylinder" in told
    # The file is read the second time, and it is what the figures come from.
    main(runs / "classes", tmp_path / "recorded.npz")
    assert capsys.readouterr().out == told
    dark = {**recorded, "camera_scans": np.zeros_like(recorded["camera_scans"])}
    np.savez(tmp_path / "recorded.npz", **dark)
    main(runs / "classes", tmp_path / "recorded.npz")
    assert capsys.readouterr().out != told


def test_new_modality(example, runs, capsys, monkeypatch):
    # Two of its three sensors, which compile in half the time.
    two = ["--modalities", "lidar", "thermal", "--jmvae.reconstruction-weights", "10", "10"]
    summary = run(example("new_modality"), runs / "thermal", *two, "--mission.episodes", "1")
    assert summary["detectors"]["thermal"]["accuracy"] >= 0.95
    assert set(summary["dqn"]) == {"lidar", "thermal"}
    config, models = jaxsense.load(runs / "thermal")
    assert config.labels("thermal") == ("cold", "hot")
    assert len(models.detectors) == 2


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
