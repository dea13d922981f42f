"""What settings of JAX change: strict promotion."""

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
