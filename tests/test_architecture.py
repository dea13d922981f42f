"""The directions of imports, as `pyproject.toml` states them, and what the page on them names."""

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest
from importlinter.cli import EXIT_STATUS_SUCCESS, lint_imports

import jaxsense

ROOT = Path(__file__).parent.parent
PAGE = ROOT / "docs" / "architecture.md"
PACKAGE = Path(jaxsense.__file__).parent  # which may be installed elsewhere


def test_imports_keep_to_their_directions():
    # What is broken, and where, is in the captured output.
    status = lint_imports(str(ROOT / "pyproject.toml"), no_cache=True)
    assert status == EXIT_STATUS_SUCCESS


LEAN = {"flax", "jax", "numpy"}
SIMULATION = {"mujoco", "scipy", "trimesh"}
# For commands, pictures and files of others: `jaxsense.make` needs none of them.
COMMANDS = {
    *("gymnasium", "gymnax", "IPython", "jinja2", "matplotlib", "onnx", "orbax"),
    *("pandas", "pytest", "spox", "tensorboardX", "tensorstore", "tyro"),
}


@pytest.mark.parametrize(
    ("names", "absent"),
    [
        (["jaxsense"], LEAN | SIMULATION | COMMANDS),
        pytest.param(
            ["jaxsense.sim", "jaxsense.init", "jaxsense.make", "jaxsense.load"],
            COMMANDS,
            marks=pytest.mark.slow,
        ),
    ],
)
def test_an_import_takes_no_longer_than_what_it_needs(names, absent):
    # Modules say why an import takes long; seconds would depend on the machine.
    program = "import sys, pkgutil\nfor name in sys.argv[1:]:\n pkgutil.resolve_name(name)\n"
    program += "print(*{name.partition('.')[0] for name in sys.modules})"
    command = [sys.executable, "-c", program, *names]
    ended = subprocess.run(command, capture_output=True, text=True, check=True)
    found = set(ended.stdout.split())
    assert "jaxsense" in found
    assert found & absent == set()


def folded_and_used(function):
    """Names of keys that a function folds numbers into, and also hands to something else."""
    calls = [node for node in ast.walk(function) if isinstance(node, ast.Call)]
    pairs = [
        (ast.unparse(call.func), a.id) for call in calls for a in call.args if hasattr(a, "id")
    ]
    folded = {name for called, name in pairs if called.endswith("random.fold_in")}
    used = {name for called, name in pairs if not called.endswith(("fold_in", "require_key"))}
    return (folded & used) - {node.func.id for node in calls if hasattr(node.func, "id")}


def test_a_key_into_which_a_number_is_folded_is_used_for_nothing_else():
    # JAX's own checker, `jax_debug_key_reuse`, lets this pass. `split(key)[i] == fold_in(key, i)`.
    for path in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef):
                keys = {name for name in folded_and_used(node) if "key" in name}
                assert not keys, f"{path}: {node.name}"


def test_paths_of_the_page_exist():
    paths = re.findall(r"`((?:jaxsense|tests|examples)/[\w./]*)`", PAGE.read_text())
    assert len(paths) > 20
    places = {"jaxsense": PACKAGE.parent, "tests": ROOT, "examples": ROOT}
    assert not [path for path in paths if not (places[path.split("/")[0]] / path).exists()]
