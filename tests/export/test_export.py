"""The command `export`, its file, and the example that plays it without jaxsense and JAX."""

import dataclasses
import json
import re
import sys
import zipfile

import jax
import onnx
import pytest
from exporting import ABSENT, CONFIG, COPIED, run_alone
from smoke import error_line

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


EXAMPLE = "import run_exported\nrun_exported.main()"


def test_the_example_plays_a_map_and_refuses_other_files(file, tmp_path):
    done = run_alone(EXAMPLE, file)
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert [line for line in lines if line.startswith("PoI 2 is a red cube; the map says: ")]
    done = run_alone(EXAMPLE, tmp_path / "nothing")
    assert done.returncode == 1
    assert done.stderr.endswith("nothing: cannot be read (no such file)\n")


@pytest.mark.parametrize(
    ("absent", "copied", "expected"),
    [
        (f"{ABSENT},onnxruntime", COPIED, "onnxruntime: pip install onnxruntime"),
        (ABSENT, COPIED[:1], "robot.py: copy it next to this file"),
    ],
)
def test_the_example_names_what_is_missing(file, absent, copied, expected):
    done = run_alone(EXAMPLE, file, absent=absent, copied=copied)
    assert (done.returncode, done.stderr) == (1, f"needs {expected}\n")


@pytest.mark.parametrize("package", ["onnx", "onnxruntime"])
def test_a_missing_package_is_one_line_with_its_extra(run, tmp_path, monkeypatch, capsys, package):
    monkeypatch.setitem(sys.modules, package, None)
    monkeypatch.delitem(sys.modules, "jaxsense.interfaces.robot", raising=False)
    monkeypatch.delattr(interfaces, "robot", raising=False)
    line = error_line([str(run), "--out", str(tmp_path / "x.zip")], capsys, export)
    assert line == f"jaxsense.export: {package} is not installed: pip install 'jaxsense[export]'"
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


def test_a_robot_resamples_scans_without_jaxsense():
    code = """
import numpy as np
from resampling import resample

angles, ranges = np.array([-0.1, 0.1]), np.array([1.0, 1.04])
print(resample(np.array([0.05, 0.15, 1.0]), angles, ranges, measures_distance=True))
"""
    found = run_alone(code)
    # Three quarters of the way between both beams; a quarter of a step beyond the second one.
    assert (found.stdout, found.returncode) == ("[1.03 1.04  nan]\n", 0), found.stderr
