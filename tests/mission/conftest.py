from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from teams import CONFIG, NAIVE

import jaxsense
from jaxsense import mission


@pytest.fixture(scope="session")
def team():
    return mission.make_mission(CONFIG)


@pytest.fixture(scope="session")
def models():
    return jaxsense.init(jax.random.key(0), CONFIG)


@pytest.fixture(scope="session")
def arena_of(team):
    """A mission in a chosen arena: PoIs, robots' poses, classes, policy and faults."""
    start = jax.jit(lambda *given: mission.start(team, *given))

    def make(positions, poses, classes=(0, 1, 2), policy=NAIVE, faults=None):
        classes = jnp.array(classes)
        layout = jaxsense.sim.make_layout(
            CONFIG.arena, jnp.array(positions, jnp.float32), jnp.zeros(len(classes)), classes
        )
        light = jaxsense.sim.Light(jnp.array([0.6, 0.0, 0.8]), jnp.float32(0.5), jnp.float32(0.5))
        scene = jaxsense.sim.Scene(layout, light, jnp.array(poses, jnp.float32))
        faults = mission.no_faults(CONFIG) if faults is None else faults
        return start(scene, classes, jnp.int32(policy), faults)

    return make


@pytest.fixture(scope="session")
def set_robot():
    """The state with some entries of one robot's record replaced."""

    def change(state, robot, **values):
        robots = {
            name: getattr(state.robots, name).at[robot].set(value) for name, value in values.items()
        }
        return replace(state, robots=replace(state.robots, **robots))

    return change


@pytest.fixture(scope="session")
def as_numpy():
    return lambda tree: jax.tree.map(np.asarray, tree)
