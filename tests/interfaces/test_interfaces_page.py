"""Every example of `docs/interfaces.md` runs and prints what it says."""

import importlib.util
import re
from pathlib import Path

import pytest

from jaxsense import export

PAGE = Path(__file__).parent.parent.parent / "docs" / "interfaces.md"
SNIPPETS = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
NEEDS = (
    "gymnasium", "gymnax", "rejax", "stable_baselines3", "jaxmarl", "pettingzoo", "", "gymnax",
    "gymnasium", "", "jaxmarl", "onnx",
)  # fmt: skip
NAMING = [i for i, package in enumerate(NEEDS) if not package]
"""The examples that only make what later ones use."""


@pytest.fixture(scope="module")
def names():
    found: dict = {}
    for i in NAMING:
        exec(compile(SNIPPETS[i], PAGE.name, "exec"), found)
    return found


@pytest.mark.slow  # the tests of each interface take the same steps
@pytest.mark.parametrize(("number", "package"), [(i, n) for i, n in enumerate(NEEDS) if n], ids=str)
def test_examples_run_and_print_what_they_say(
    names, number, package, tmp_path, monkeypatch, capsys
):
    if importlib.util.find_spec(package) is None:
        pytest.skip(f"{package}: needs the extra that the page names")
    if package == "stable_baselines3":
        importlib.import_module("torch").set_num_threads(1)  # more get into each other's way
    monkeypatch.chdir(tmp_path)
    if package == "onnx":
        Path("robot.zip").write_bytes(export.archive(names["config"], names["models"]))
    exec(compile(SNIPPETS[number], PAGE.name, "exec"), dict(names))
    (printed,) = re.findall(r"^print\(.*\)  # ([^;\n]*)", SNIPPETS[number], re.MULTILINE)
    assert capsys.readouterr().out == f"{printed}\n"


def test_every_example_is_run():
    assert len(NEEDS) == len(SNIPPETS)
