"""Every example of `docs/interfaces.md` runs and prints what it says."""

import importlib.util
import re
from pathlib import Path

import pytest

from jaxsense import export

PAGE = Path(__file__).parent.parent.parent / "docs" / "interfaces.md"
SNIPPETS = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
PACKAGES = ("gymnax", "gymnasium", "jaxmarl", "onnx")
OF_TASKS = ("gymnasium", "gymnax", "rejax", "stable_baselines3", "jaxmarl", "pettingzoo")
FIRST, *OTHERS = SNIPPETS[len(OF_TASKS) :]
TEAM = OTHERS.pop(2)
EXAMPLES = dict(zip(PACKAGES, OTHERS, strict=True))
TASKS = dict(zip(OF_TASKS, SNIPPETS, strict=False))


@pytest.fixture(scope="module")
def names():
    """What the first example, and that of a team, define."""
    found: dict = {}
    for example in (FIRST, TEAM):
        exec(compile(example, PAGE.name, "exec"), found)
    return found


@pytest.mark.slow  # the tests of each interface take the same steps
@pytest.mark.parametrize("package", EXAMPLES)
def test_examples_run(names, package, tmp_path, monkeypatch, capsys):
    example = EXAMPLES[package]
    if importlib.util.find_spec(package) is None:
        pytest.skip(f"{package}: needs the extra that the page names")
    monkeypatch.chdir(tmp_path)
    if package == "onnx":
        Path("robot.zip").write_bytes(export.archive(names["config"], names["models"]))
    exec(compile(example, PAGE.name, "exec"), dict(names))
    (printed,) = re.findall(r"^print\(.*\)  # (.*)$", example, re.MULTILINE)
    assert capsys.readouterr().out == f"{printed}\n"


@pytest.mark.slow  # the tests of each interface take the same steps
@pytest.mark.parametrize("package", TASKS)
def test_examples_of_tasks_run(package, capsys):
    if importlib.util.find_spec(package) is None:
        pytest.skip(f"{package}: needs the extra that the page names")
    if package == "stable_baselines3":
        importlib.import_module("torch").set_num_threads(1)  # more get into each other's way
    exec(compile(TASKS[package], PAGE.name, "exec"), {})
    (printed,) = re.findall(r"^print\(.*\)  # ([^;\n]*)", TASKS[package], re.MULTILINE)
    assert capsys.readouterr().out == f"{printed}\n"
