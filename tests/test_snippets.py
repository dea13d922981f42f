"""The snippets of `docs/extending.md` and `docs/robot.md` run and do what the pages say."""

import dataclasses
import importlib
import re
import zipfile
from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np
import onnx
import pytest
from onnx import numpy_helper

from jaxsense import PRESETS, export, train

ROOT = Path(__file__).parent.parent


def snippets(page):
    text = (ROOT / "docs" / page).read_text(encoding="utf-8")
    return re.findall(r"```python\n(.*?)```", text, re.DOTALL)


PROGRAM, CLASSES, ATTRIBUTE, SENSOR, SETTINGS, *_ = snippets("extending.md")
PLAYED, RESAMPLED, LOOKS, _, RETRAINED, ARCHIVED = snippets("robot.md")


@pytest.fixture
def example(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "examples")
    return importlib.import_module


def run(*parts, **names):
    """The names that snippets of one program define, without any other names."""
    for part in parts:
        exec(part, names)
    return names


def test_a_program_trains_with_its_own_change(monkeypatch):
    given = []
    options = ["--preset", "smoke"]
    monkeypatch.setattr(train, "main", lambda change: given.append(train.parse(options, change)))
    run(PROGRAM, __name__="imported")
    assert given == []
    run(PROGRAM, __name__="__main__")
    assert [each.settings.config.carried for each in given] == [("camera", "camera", "lidar")]


def test_classes_are_those_of_the_example(example):
    config = PRESETS["smoke"]
    assert run(CLASSES)["change"](config) == example("new_classes").change(config)


def test_a_modality_is_that_of_the_example(example):
    config, found = PRESETS["smoke"], run(ATTRIBUTE, SENSOR, SETTINGS)
    module = example("new_modality")
    expected = module.change(config)
    assert found["change"](config) == expected
    ours, theirs = found["thermal"](config), module.thermal(expected)
    assert dataclasses.asdict(ours) == dataclasses.asdict(theirs)
    # The class is written out on the page; its readings are those of the example's.
    hits = SimpleNamespace(geom=np.array([0, 1, 2, 1]))
    readings = [
        sensor.read(jax.random.key(0), hits, {"temperature": np.array([20.0, 30.0, 60.0])}, None)
        for sensor in (ours, theirs)
    ]
    np.testing.assert_array_equal(*readings)


@pytest.fixture
def recording(example):
    """Simulated looks at a PoI of each class."""
    return example("recorded_scans").simulate(PRESETS["default"])


@pytest.mark.slow
def test_looks_fill_the_map(recording, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    np.savez("recorded.npz", **recording)
    found = run(LOOKS)
    assert found["seen"].all()
    assert capsys.readouterr().out == f"{PRESETS['default'].arena.classes[0]}\n"
    # Each look adds to the ones before it: the LiDAR alone says less.
    both, alone = map(found["models"].fusion.class_probabilities, (found["belief"], found["alone"]))
    assert both[0] > max(0.9, alone[0])


def test_an_archive_reads_scans(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    export.main(["pretrained:noisy", "--out", "robot.zip"])
    capsys.readouterr()
    assert run(PLAYED, RESAMPLED)["scan"].shape == (683,)
    printed = "False {'cylinder': 0.5, 'cube': 0.5}\n(683,) True\nFalse\n"
    assert capsys.readouterr().out == printed


@pytest.mark.slow
def test_a_detector_is_retrained_with_labelled_looks(recording, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    looks = {name: np.concatenate([x] * 4) for name, x in recording.items()}
    labels = np.tile(PRESETS["default"].arena.label_of_class("shape"), 4)
    np.savez("known.npz", **looks)
    np.save("labels.npy", labels)
    found = run(RETRAINED, ARCHIVED)
    features = jax.vmap(found["detector"].features)(np.stack(found["windows"]))
    np.testing.assert_array_equal(np.argmax(features, axis=1), labels)
    # The archive holds the retrained detector.
    with zipfile.ZipFile("robot.zip") as archive:
        graph = onnx.load_model_from_string(archive.read("detect_lidar.onnx")).graph
    own = {each.name: numpy_helper.to_array(each) for each in graph.initializer}
    kept = own["detectors/1/params/params/Dense_0/kernel"]
    np.testing.assert_array_equal(kept, found["detector"].params["params"]["Dense_0"]["kernel"])
