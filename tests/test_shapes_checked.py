"""Shapes in the signatures of jaxsense, checked at every call by jaxtyping."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow  # half a minute: a training and a mission, every call checked


@pytest.fixture(scope="module")
def found():
    """What a process in which all shapes are checked has checked and refused."""
    program = Path(__file__).parent / "shapes.py"
    done = subprocess.run([sys.executable, program], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def test_a_training_and_a_mission_have_the_shapes_that_signatures_say(found):
    checked = [name.removeprefix("jaxsense.") for name in found["checked"]]
    assert len(checked) > 100
    for name in ("core.networks.MLP.__call__", "vae.fusion.InPlace.update", "looks.Bank.observe"):
        assert name in checked
    for room in ("core", "vae", "dqn", "looks", "training"):
        assert any(name.startswith(f"{room}.") for name in checked)


@pytest.mark.parametrize("name", ["kl_divergence", "log_likelihoods", "update"])
def test_an_array_of_the_wrong_shape_or_type_is_refused(found, name):
    line = found["refused"][name]
    assert line.startswith("Type-check error whilst checking the parameters of jaxsense.")
    assert line.endswith(f".{name}.")
