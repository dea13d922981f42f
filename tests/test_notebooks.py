"""The notebooks run from top to bottom, and store no output."""

import json
from pathlib import Path

import numpy as np
import pytest

NOTEBOOKS = sorted((Path(__file__).parent.parent / "examples" / "notebooks").glob("*.ipynb"))


def cells_of(path, kind="code"):
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    return ["".join(cell["source"]) for cell in cells if cell["cell_type"] == kind]


def run(path, directory, monkeypatch):
    """Runs all cells of a notebook in one namespace, as Jupyter does; gives what they leave."""
    monkeypatch.chdir(directory)
    monkeypatch.setenv("MPLBACKEND", "agg")
    names = {"__name__": "__main__"}
    for number, cell in enumerate(cells_of(path)):
        exec(compile(cell, f"{path.name}, cell {number}", "exec"), names)
    return names


def notebook(name):
    return next(path for path in NOTEBOOKS if path.stem == name)


@pytest.mark.slow  # compiles a score; before a release, as the examples of the page of tasks
def test_the_tasks(tmp_path, monkeypatch, capsys):
    run(notebook("tasks"), tmp_path, monkeypatch)
    printed = capsys.readouterr().out
    assert "noisy-v0, lidar, 10 seeds: return" in printed


@pytest.mark.slow  # the same functions run in the examples of pages
def test_the_jmvae_and_fusion(tmp_path, monkeypatch, capsys):
    names = run(notebook("jmvae_and_fusion"), tmp_path, monkeypatch)
    printed = capsys.readouterr().out
    assert "possible: red cylinder, red cube" in printed
    assert "possible: green cylinder, red cylinder" in printed
    assert "possible: red cylinder\n" in printed
    # Both of the uncertain sensors spoke for a red cylinder.
    assert names["chances"].argmax() == 1
    assert 0.6 < names["chances"].max() < 1


@pytest.mark.slow  # as above
def test_single_functions(tmp_path, monkeypatch, capsys):
    names = run(notebook("single_functions"), tmp_path, monkeypatch)
    np.testing.assert_allclose(names["place"], [0.2, -0.1], atol=2e-3)
    printed = capsys.readouterr().out
    assert "0.50 certain" in printed
    assert "0.99 certain" in printed
    assert printed.count("look") >= 1
    assert printed.rstrip().endswith("stop")


@pytest.mark.slow
def test_your_robot(tmp_path, monkeypatch, capsys):
    names = run(notebook("your_robot"), tmp_path, monkeypatch)
    printed = capsys.readouterr().out
    assert "is there: True" in printed
    assert printed.count("distance 0.8: True") == 1
    assert "bearing 0.0, distance 1.1: False" in printed
    assert "bearing 0.6, distance 0.8: False" in printed
    assert "bearing 0.0, distance 1.3: False, not known" in printed
    assert "['green cylinder', 'red cylinder']" in printed
    assert [*tmp_path.iterdir()] == [tmp_path / "robot.zip"]
    assert names["said"]["most_likely"].shape == (3,)
