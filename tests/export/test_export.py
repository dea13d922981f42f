"""The command `export`, its file, and the example that plays it without jaxsense and JAX."""

import dataclasses
import json
import re
import runpy
import sys
import zipfile
from types import SimpleNamespace

import jax
import onnx
import pytest
from exporting import ABSENT, CONFIG, run_alone
from smoke import error_line

from benchmarks import exported
from jaxsense import export, interfaces
from jaxsense.models import init


def test_onnx_files_name_what_they_take_and_give(file):
    with zipfile.ZipFile(file) as files:
        contents = json.loads(files.read("contents.json"))
        for name, about in contents["programs"].items():
            graph = onnx.load_model_from_string(files.read(f"{name}.onnx")).graph
            for ends, key in ((graph.input, "inputs"), (graph.output, "outputs")):
                shapes = {
                    each.name: [n.dim_param or n.dim_value for n in each.type.tensor_type.shape.dim]
                    for each in ends
                }
                assert shapes == {n: x["shape"] for n, x in about[key].items()}


@pytest.mark.parametrize("variance", [20.0, 5.0])
def test_contents_hold_the_belief_before_any_look(variance):
    config = dataclasses.replace(
        CONFIG, mdp=dataclasses.replace(CONFIG.mdp, unseen_variance=variance)
    )
    contents = export._description(config, init(jax.random.key(0), config))
    assert contents["unseen"] == {"mean": [0.0, 0.0], "std": pytest.approx([variance**0.5] * 2)}


@pytest.mark.parametrize("player", [*ABSENT])
def test_the_example_plays_a_map_and_refuses_other_files(file, tmp_path, player):
    options = ["--onnx"] if player == "robot_onnx" else []
    done = run_alone("example['main']()", player, file, *options)
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert [line for line in lines if line.startswith("PoI 2 is a red cube; the map says: ")]
    (tmp_path / "text").write_text("no archive")
    done = run_alone("example['main']()", player, tmp_path / "text", *options)
    assert done.returncode == 1
    assert "must be a file of `jaxsense export`" in done.stderr
    done = run_alone("example['main']()", player, tmp_path / "nothing", *options)
    assert done.returncode == 1
    assert done.stderr.endswith("nothing: no such file\n")


def test_the_example_names_the_missing_onnxruntime(file):
    done = run_alone("example['main']()", "robot_numpy", file, "--onnx")
    assert done.returncode == 1
    assert done.stderr == "--onnx needs onnxruntime: pip install onnxruntime\n"


def test_the_comparison_needs_numpy_alone(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    monkeypatch.delitem(sys.modules, "jaxsense.interfaces.robot_onnx", raising=False)
    monkeypatch.delattr(interfaces, "robot_onnx", raising=False)
    names = runpy.run_path(exported.__file__)
    assert [*names["LOADERS"]] == ["NumPy"]
    main, stub = names["main"], SimpleNamespace(load=lambda *_: [None] * 3, archive=lambda *_: b"")
    stubs = {"export": stub, "choices": lambda *_: [], "compare": lambda *_: {"NumPy": {}}}
    for name, each in {**stubs, "devices": SimpleNamespace(start=lambda *_: None)}.items():
        monkeypatch.setitem(main.__globals__, name, each)
    main(["pretrained:default"])
    assert "NumPy alone: onnxruntime is not installed" in capsys.readouterr().out


def test_a_missing_package_is_one_line_with_its_extra(run, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "onnx", None)
    line = error_line([str(run), "--out", str(tmp_path / "x.zip")], capsys, export)
    assert line == "jaxsense.export: onnx is not installed: pip install 'jaxsense[export]'"
    assert not [*tmp_path.iterdir()]


@pytest.mark.parametrize("problem", ["run", "out", "folder"])
def test_bad_input_is_one_line_and_overwrites_nothing(run, tmp_path, capsys, problem):
    existing = tmp_path / "precious.zip"
    existing.write_text("precious")
    argv, expected = {
        "run": ([str(tmp_path / "no_run")], "no_run is not a run directory: it has no config.json"),
        "out": ([str(run), "--out", str(existing)], "out = .*already exists; must be a new file"),
        "folder": ([str(run), "--out", str(tmp_path / "no" / "x.zip")], "out = .*cannot be writ"),
    }[problem]
    with pytest.raises(SystemExit) as stop:
        export.main(argv)
    message = capsys.readouterr().err
    assert stop.value.code == 2
    assert message.count("\n") == 1
    assert message.startswith("jaxsense.export: ")
    assert re.search(expected, message)
    assert existing.read_text() == "precious"
    assert list(tmp_path.iterdir()) == [existing]


def test_a_file_that_appears_meanwhile_is_not_replaced(run, tmp_path, monkeypatch, capsys):
    path = tmp_path / "x.zip"

    def meanwhile(*_):
        path.write_text("of another process", encoding="utf-8")
        return b"ours"

    monkeypatch.setattr(export, "archive", meanwhile)
    line = error_line([str(run), "--out", str(path)], capsys, export)
    assert "x.zip': already exists; must be a new file" in line
    assert [*tmp_path.iterdir()] == [path]
    assert path.read_text(encoding="utf-8") == "of another process"


def test_an_export_that_is_stopped_leaves_nothing(run, tmp_path, monkeypatch):
    def stop(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(export, "archive", stop)
    with pytest.raises(KeyboardInterrupt):
        export.main([str(run), "--out", str(tmp_path / "x.zip")])
    assert not [*tmp_path.iterdir()]


def test_a_robot_resamples_scans_without_jaxsense(file):
    code = """
import numpy as np

sys.path.insert(0, sys.argv[1])
from resampling import resample

angles, ranges = np.array([-0.1, 0.1]), np.array([1.0, 1.04])
print(resample(np.array([0.05, 0.15, 1.0]), angles, ranges, measures_distance=True))
"""
    found = run_alone(code, "robot_numpy", file)
    # Three quarters of the way between both beams; a quarter of a step beyond the second one.
    assert (found.stdout, found.returncode) == ("[1.03 1.04  nan]\n", 0), found.stderr
