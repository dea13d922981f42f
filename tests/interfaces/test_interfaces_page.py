"""Every example of `docs/interfaces.md` runs and prints what it says."""

import dataclasses
import re
from pathlib import Path

import jax
import numpy as np
import pytest

from jaxsense import export
from jaxsense.interfaces import detections

PAGE = Path(__file__).parent.parent.parent / "docs" / "interfaces.md"
FIRST, *EXAMPLES = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
PACKAGES = ("gymnax", "rejax", "gymnasium", "stable_baselines3", "flatbuffers")


@pytest.fixture(scope="module")
def names():
    """What the first example defines."""
    found: dict = {}
    exec(compile(FIRST, PAGE.name, "exec"), found)
    return found


@pytest.mark.parametrize(("package", "example"), zip(PACKAGES, EXAMPLES, strict=True), ids=PACKAGES)
def test_examples_run(names, package, example, tmp_path, monkeypatch, capsys):
    pytest.importorskip(package, reason="needs the extra that the page names")
    monkeypatch.chdir(tmp_path)
    if package == "flatbuffers":
        Path("robot.zip").write_bytes(export.archive(names["config"], names["models"]))
    exec(compile(example, PAGE.name, "exec"), dict(names))
    (printed,) = re.findall(r"^print\(.*\)  # (.*)$", example, re.MULTILINE)
    assert capsys.readouterr().out == f"{printed}\n"


def test_detections_are_of_the_classes_that_they_are_stored_under(names):
    config, models = names["config"], names["models"]
    # Untrained detectors are sure of anything; with windows as they are they are not.
    mild = tuple(dataclasses.replace(d, scale=10.0) for d in models.detectors)
    bank = detections(jax.random.key(5), config, dataclasses.replace(models, detectors=mild), 50)
    assert [x.shape for x in bank] == [(3, 50, 2)] * 2
    np.testing.assert_allclose(np.sum(bank[0], axis=-1), 1.0, rtol=1e-5)
    green, red, also_red = np.asarray(bank[0]).mean(axis=1)[:, 0]
    assert abs(green - red) > 4 * abs(red - also_red)
