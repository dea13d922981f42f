"""The class belongs to the tree definition: no program of one class runs with another."""

import jax
import jax.numpy as jnp

from jaxsense import sim
from jaxsense.core.types import Belief, by_place, others, pytree


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


def test_a_class_that_is_defined_again_runs_its_own_program():
    rewards = [own_reward(float(value))(0.0) for value in range(12)]
    assert [float(paid(reward, 1.0)) for reward in rewards] == list(range(12))


def test_leaves_are_found_by_their_places():
    tree = {"a": (Belief(1, 2),), "b": {"c": 3}}
    assert by_place(tree) == {"a/0/mean": 1, "a/0/std": 2, "b/c": 3}


def test_all_rows_but_one_begin_after_it():
    assert others(jnp.arange(4), 1).tolist() == [2, 3, 0]


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
