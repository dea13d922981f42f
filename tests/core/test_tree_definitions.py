"""The class belongs to the tree definition: no program of one class runs with another."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import serialization

from jaxsense import sim
from jaxsense.core.types import Belief, pytree


def own_reward(value):
    """As a notebook's cell defines it each time that it is run."""

    @pytree
    class Mine:
        cost: jax.Array

        def of_gain(self, gain):
            return value * gain - self.cost

    return Mine


@jax.jit
def paid(reward, gain):
    return reward.of_gain(gain)


def wrong_programs(number):
    rewards = [own_reward(float(value))(0.0) for value in range(number)]
    return sum(float(paid(reward, 1.0)) != value for value, reward in enumerate(rewards))


def test_a_class_that_is_defined_again_runs_its_own_program():
    assert wrong_programs(12) == 0


def test_state_dictionaries_are_those_of_earlier_checkpoints():
    belief = Belief(jnp.arange(2.0), jnp.ones(2))
    state = serialization.to_state_dict(belief)
    assert list(state) == ["mean", "std"]
    blank = jax.tree.map(jnp.zeros_like, belief)
    found = serialization.from_state_dict(blank, state)
    np.testing.assert_array_equal(found.mean, [0, 1])
    with pytest.raises(ValueError, match="Belief"):
        serialization.from_state_dict(blank, {"mean": state["mean"]})


def own_sensor(value):
    class Own(sim.Sensor):
        gain: jax.Array

        def read(self, key, hits, surfaces, light):
            return value * self.gain

    return Own(jnp.float32(1), height=0.1, rays=sim.Fan(8, 90.0), window=4)


def test_a_sensor_that_is_defined_again_runs_its_own_program():
    read = jax.jit(lambda sensor: sensor.read(None, None, None, None))
    own = [own_sensor(float(value)) for value in range(12)]
    assert [float(read(sensor)) for sensor in own] == list(range(12))
    assert jax.tree.structure(own[0]) != jax.tree.structure(own[1])
