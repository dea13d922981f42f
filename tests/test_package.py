"""The package as a whole: the examples of the README and of the documentation."""

import re
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parent.parent


def run_example(path: Path, which: int = -1) -> dict:
    """Runs a Python example of a page, by default the last; gives the names that it leaves."""
    examples = re.findall(r"```python\n(.*?)```", path.read_text(), re.DOTALL)
    names: dict = {}
    exec(compile(examples[which], path.name, "exec"), names)
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


@pytest.mark.slow  # trains as far as the latent space
def test_example_of_several_settings_runs(capsys):
    names = run_example(ROOT / "docs" / "getting-started.md", 0)
    assert capsys.readouterr().out == f"{names['metrics'].active_units}\n"
    assert names["metrics"].active_units.shape == (3,)
