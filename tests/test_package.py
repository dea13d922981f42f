"""The package as a whole: the examples of the README and of the documentation."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent


def run_example(path: Path, which: int = -1) -> dict:
    """Runs a Python example of a page, by default the last; gives the names that it leaves."""
    names: dict = {}
    examples = re.findall(r"```python\n(.*?)```", path.read_text(), re.DOTALL)
    exec(compile(examples[which], path.name, "exec"), names)
    return names


def test_example_of_the_readme_runs(capsys):
    names = run_example(ROOT / "README.md")
    assert capsys.readouterr().out == f"(12,) {names['seen'].reward!s}\n"
    # A look costs 0.1 nats, and tells at most which of three classes it is: log 3 = 1.10.
    assert -0.1 <= float(names["seen"].reward) < 1.0


DECIMAL = r"-?\d+\.\d+"
PAGES = [
    ("getting-started.md", -1, r"\(64, 2\) \(64, 2\)\n"),
    ("getting-started.md", 0, r"\[.*\]\n"),  # trains as far as the latent space
    *(("functions.md", i, ".*") for i in range(5)),
    ("jmvae.md", -1, rf"\(200, 2\) \(200, 2\)\n.* (1\.0|0\.99)\d*\n.* {DECIMAL}\n"),
    ("tasks.md", 0, ".*"),
    ("tasks.md", 1, ".*"),
    ("tasks.md", 2, r"(.*False.*\n)\1"),  # of the observation, and of the state
    *(("tasks.md", i, ".*noisy-v0, camera, 10 seeds: return.*") for i in (3, 5)),
    ("tasks.md", 4, r".*\(10,\)\n"),
    ("tasks.md", 6, ".*mine.*"),
    ("tasks.md", 7, rf".*map-v0, camera, \d+ seeds?: return {DECIMAL}.*random.*"),
    ("tasks.md", 8, ".*--preset team --seed 0.*"),
]


@pytest.mark.slow
@pytest.mark.parametrize(("page", "which", "printed"), PAGES)
def test_examples_of_the_pages_run(page, which, printed, capsys):
    run_example(ROOT / "docs" / page, which)
    assert re.fullmatch(printed, capsys.readouterr().out, re.DOTALL)
