"""The package as a whole: the examples of the README and of the documentation."""

import re
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parent.parent


def run_example(path: Path) -> dict:
    """Runs the last Python example of a page; gives the names that it leaves behind."""
    *_, example = re.findall(r"```python\n(.*?)```", path.read_text(), re.DOTALL)
    names: dict = {}
    exec(compile(example, path.name, "exec"), names)
    return names


def test_example_of_the_readme_runs(capsys):
    names = run_example(ROOT / "README.md")
    assert capsys.readouterr().out == "(64, 3, 2) (64,)\n"
    assert np.isfinite(names["states"].belief.mean).all()
    assert (np.asarray(names["states"].belief.std) > 0).all()
    assert np.isfinite(names["outcomes"].reward).all()


def test_example_of_the_first_steps_runs(capsys):
    belief = run_example(ROOT / "docs" / "getting-started.md")["belief"]
    assert capsys.readouterr().out == "(64, 2) (64, 2)\n"
    assert np.isfinite(belief.mean).all()
    assert (np.asarray(belief.std) > 0).all()
