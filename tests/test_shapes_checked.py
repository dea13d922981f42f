"""Shapes in signatures, checked at every call by jaxtyping; types under strict promotion."""

import json
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsense
from jaxsense import Transition, dqn, sim
from jaxsense.config import MdpConfig
from jaxsense.core.types import Belief
from jaxsense.dqn import replay
from jaxsense.mission import roadmap


@pytest.fixture(scope="module")
def found():
    """What a process in which all shapes are checked has checked and refused."""
    program = Path(__file__).parent / "shapes.py"
    done = subprocess.run([sys.executable, program], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.slow  # half a minute: a training and a mission, every call checked
def test_a_training_and_a_mission_have_the_shapes_that_signatures_say(found):
    checked = [name.removeprefix("jaxsense.") for name in found["checked"]]
    assert len(checked) > 100
    for name in ("core.networks.MLP.__call__", "vae.fusion.InPlace.update", "looks.Bank.observe"):
        assert name in checked
    for room in ("core", "vae", "dqn", "looks", "training"):
        assert any(name.startswith(f"{room}.") for name in checked)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["kl_divergence", "log_likelihoods", "update"])
def test_an_array_of_the_wrong_shape_or_type_is_refused(found, name):
    line = found["refused"][name]
    assert line.startswith("Type-check error whilst checking the parameters of jaxsense.")
    assert line.endswith(f".{name}.")


KEY = jax.random.key(0)
CONFIG = jaxsense.PRESETS["default"]


def play(name):
    task = jaxsense.make(name)
    task.play_reference(KEY, "naive")
    return task.play(KEY, lambda key, memory, seen: (jax.random.randint(key, (), 0, 4), ()), ())


def paths():
    layout = sim.random_layout(KEY, CONFIG.arena, jnp.array([0, 1, 2]))
    return roadmap.build(CONFIG, layout).lengths(jnp.zeros(2), 1)


def values():
    """Of looks at two classes that are right four times out of five."""
    right, wrong = np.log(0.8), np.log(0.2)
    looks = np.full((2, 5, 2), wrong)
    looks[0, :4, 0] = looks[1, :4, 1] = looks[0, 4, 1] = looks[1, 4, 0] = right
    prior = Belief(jnp.zeros(1), jnp.ones(1))
    return dqn.value_iteration(
        jnp.asarray(looks, jnp.float32), dqn.Nats(0.1), lambda p: prior, prior, MdpConfig(), 8
    )


def remember():
    states, scalars = jnp.ones((3, 8)), jnp.zeros(8)
    seen = Transition(states, scalars.astype(jnp.int32), scalars, scalars, states)
    memory = replay.add(replay.init(3, 5, 2, 4), seen)
    return replay.sample(jnp.zeros((2, 2)), memory)


@pytest.mark.parametrize(
    "function",
    [
        lambda: play("map-v0"),
        lambda: play("team-v0"),
        paths,
        values,
        remember,
    ],
)
def test_functions_trace_with_strict_promotion(function):
    with jax.numpy_dtype_promotion("strict"):
        jax.eval_shape(function)
