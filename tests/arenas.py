"""Fixtures of arenas, for the tests of the simulation and of missions."""

import copy
import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from jaxsense import sim
from jaxsense.config.scene import ArenaConfig
from jaxsense.sim.arena import build, sized


@pytest.fixture(scope="session")
def arena():
    """An arena without contacts, in which robot 1 carries the laser scanner."""
    return build(ArenaConfig(), (False, True), contacts=False)


@pytest.fixture(scope="session")
def place(arena):
    return jax.jit(lambda layout, poses: sim.place(arena, layout, poses))


@pytest.fixture(scope="session")
def set_native(arena):
    """The state of C MuJoCo that equals an MJX state, after its own kinematics."""

    def native(data, of=arena):
        mj_data = mujoco.MjData(of.mj_model)
        mj_data.mocap_pos[:] = data.mocap_pos
        mj_data.mocap_quat[:] = data.mocap_quat
        mj_data.qpos[:] = data.qpos
        mujoco.mj_kinematics(of.mj_model, mj_data)
        return mj_data

    return native


def natively_sized(arena, layout):
    """The arena in whose C MuJoCo inner walls are as long as in a layout."""
    model = copy.copy(arena.mj_model)
    model.geom_size[:] = sized(arena, layout).model.geom_size
    return dataclasses.replace(arena, mj_model=model)


@pytest.fixture(scope="session")
def known_layout():
    """A green cylinder at the origin, a cube turned by 30 degrees at (0, 1), another at (1, -1)."""
    position = jnp.array([[0.0, 0.0], [0.0, 1.0], [1.0, -1.0]])
    yaw = jnp.array([0.0, np.radians(30.0), 0.0])
    return sim.make_layout(ArenaConfig(), position, yaw, jnp.array([0, 2, 2]))
