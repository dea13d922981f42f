"""The notebooks run from top to bottom, and print what their text says."""

import json
import re
from pathlib import Path

import pytest

NOTEBOOKS = Path(__file__).parent.parent / "examples" / "notebooks"
PRINTED = {
    "tasks": [r"noisy-v0, lidar, 10 seeds: return"],
    # Both of the uncertain sensors spoke for a red cylinder.
    "jmvae_and_fusion": [
        "possible: red cylinder, red cube",
        "possible: green cylinder, red cylinder",
        "possible: red cylinder\n",
    ],
    "single_functions": [r"0\.50 certain", r"0\.99 certain", "look", r"stop\s*$"],
    "your_robot": [
        "is there: True",
        r"distance 0\.8: True",
        r"bearing 0\.0, distance 1\.1: False",
        r"bearing 0\.6, distance 0\.8: False",
        r"bearing 0\.0, distance 1\.3: False, not known",
        r"\['green cylinder', 'red cylinder'\]",
    ],
}


def test_every_notebook_is_run():
    assert {path.stem for path in NOTEBOOKS.glob("*.ipynb")} == PRINTED.keys()


@pytest.mark.slow  # the same functions run in the examples of pages
@pytest.mark.parametrize("name", PRINTED)
def test_a_notebook_prints_what_its_text_says(name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "agg")
    cells = json.loads((NOTEBOOKS / f"{name}.ipynb").read_text(encoding="utf-8"))["cells"]
    names = {"__name__": "__main__"}
    for number, cell in enumerate(cells):
        if cell["cell_type"] == "code":
            exec(compile("".join(cell["source"]), f"{name}, cell {number}", "exec"), names)
    printed = capsys.readouterr().out
    assert not [line for line in PRINTED[name] if not re.search(line, printed)]
