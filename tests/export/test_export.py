"""The command `export`, and the example that plays its file without jaxsense and JAX."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from exporting import EXAMPLE
from smoke import error_line

from jaxsense import export, interfaces
from jaxsense.interfaces import robot
from jaxsense.recorded import resampling

COPIED = EXAMPLE, Path(robot.__file__), Path(resampling.__file__)
"""What a robot needs besides an archive."""
ALONE = """
import sys

absent = sys.argv.pop(1).split(",")

class Only:
    def find_spec(self, name, *_):
        if name.partition(".")[0] in absent:
            raise ModuleNotFoundError(f"{name} is not here", name=name)

sys.meta_path.insert(0, Only())
sys.path.insert(0, sys.argv.pop(1))
import resampling
import run_exported
run_exported.main()
"""
ABSENT = "jaxsense,jax,jaxlib,onnx,spox"


def run_alone(folder, *arguments, absent=ABSENT, copied=COPIED):
    """Runs the example where nothing is there but what a robot needs."""
    for file in copied:
        shutil.copy(file, folder)
    command = [sys.executable, "-I", "-c", ALONE, absent, folder, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_the_example_plays_a_map_without_jaxsense(file, tmp_path):
    done = run_alone(tmp_path, file)
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert [line for line in lines if line.startswith("PoI 2 is a red cube; the map says: ")]


@pytest.mark.parametrize(
    ("absent", "copied", "expected"),
    [
        (f"{ABSENT},onnxruntime", COPIED, "needs onnxruntime: pip install onnxruntime"),
        (ABSENT, (COPIED[0], COPIED[2]), "needs robot.py: copy it next to this file"),
        (ABSENT, COPIED, "nothing: cannot be read (no such file)"),
    ],
)
def test_the_example_names_what_is_missing(tmp_path, absent, copied, expected):
    done = run_alone(tmp_path, tmp_path / "nothing", absent=absent, copied=copied)
    assert done.returncode == 1
    assert done.stderr.endswith(f"{expected}\n")


@pytest.mark.parametrize("package", ["onnx", "onnxruntime", "spox"])
def test_a_missing_package_is_one_line_with_its_extra(run, tmp_path, monkeypatch, capsys, package):
    monkeypatch.setitem(sys.modules, package, None)
    for name in ("robot", "translate"):
        monkeypatch.delitem(sys.modules, f"jaxsense.interfaces.{name}", raising=False)
        monkeypatch.delattr(interfaces, name, raising=False)
    line = error_line([str(run), "--out", str(tmp_path / "x.zip")], capsys, export)
    assert line == f"jaxsense.export: {package} is not installed: pip install 'jaxsense[export]'"
    assert not [*tmp_path.iterdir()]


def test_missions_that_the_network_did_not_learn_for_are_told(run, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(export, "beyond_training", lambda config: ["9 PoIs: too many"])
    monkeypatch.setattr(export, "archive", lambda config, models: b"")
    export.main([str(run), "--out", str(tmp_path / "x.zip")])
    assert capsys.readouterr().err == "jaxsense.export: 9 PoIs: too many\n"
