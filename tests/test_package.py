"""The package as a whole: the README's example, and the direction of its imports."""

import ast
import re
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parent.parent


def test_example_of_the_readme_runs(capsys):
    (example,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    names: dict = {}
    exec(compile(example, "README.md", "exec"), names)
    assert capsys.readouterr().out == "(64,) (64, 2) (64, 2) (64,)\n"
    assert (np.asarray(names["distance"]) > 0).all()
    assert np.isfinite(names["distance"]).all()
    assert (np.asarray(names["std"]) > 0).all()
    assert np.isfinite(names["mean"]).all()
    assert np.isfinite(names["reward"]).all()


def imports_of(path: Path) -> set[str]:
    """The modules of jaxsense that a file imports."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module:
            found |= {f"{node.module}.{name.name}" for name in node.names}
        elif isinstance(node, ast.Import):
            found |= {name.name for name in node.names}
    return {name for name in found if name.startswith("jaxsense")}


def test_imports_run_one_way():
    parts = ("sim", "vae", "dqn")
    top = (
        "observe", "models", "mission", "programs", "pipeline", "examine", "rundir", "report",
        "animation", "page", "colours", "train", "evaluate", "cli", "display", "monitor",
    )  # fmt: skip
    for part in parts:
        for path in (ROOT / "jaxsense" / part).glob("*.py"):
            for name in imports_of(path):
                imported = name.split(".")[1]
                assert imported == part or imported not in (*parts, *top), f"{path}: {name}"
    base = {"types", "config", "networks", "training", "indexing", "devices"}
    for module in (*(base - {"config"}), "monitor"):
        allowed = base - {module}
        for name in imports_of(ROOT / "jaxsense" / f"{module}.py"):
            assert name.split(".")[1] in allowed, f"{module}: {name}"
    for path in (ROOT / "jaxsense" / "config").glob("*.py"):
        for name in imports_of(path):
            assert name.split(".")[1] in base, f"{path}: {name}"
    below = {*base, "models", "monitor", "mission", *parts}
    for path in (ROOT / "jaxsense" / "mission").glob("*.py"):
        for name in imports_of(path):
            assert name.split(".")[1] in below, f"{path}: {name}"


def test_inner_modules_never_import_the_package_root():
    for path in (ROOT / "jaxsense").rglob("*.py"):
        tree = ast.parse(path.read_text())
        for node in ast.walk(tree):
            if isinstance(node, ast.Import):
                assert "jaxsense" not in [name.name for name in node.names], path
