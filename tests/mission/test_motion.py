"""Physics of a control period, with contacts and without."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from teams import AHEAD, CONFIG

from jaxsense import mission
from jaxsense.mission.rollout import move as move_all
from jaxsense.sim import amiro


@pytest.fixture(scope="module")
def pushing(arena_of, set_robot):
    """Missions in which the camera robot drives at a cylinder from `gaps` metres away."""

    def make(*gaps):
        states = []
        for gap in gaps:
            x = 0.8 - CONFIG.arena.poi_radius - amiro.BODY_RADIUS - gap
            state = arena_of(AHEAD, [[x, 0.0, 0.0], [0.0, 1.2, 0.0]], classes=(0, 1, 2))
            speed = jnp.array([amiro.MAX_SPEED, 0.0])
            states.append(set_robot(state, 0, command=speed, wanted=speed))
        return jax.tree.map(lambda *x: jnp.stack(x), *states)

    return make


@pytest.fixture(scope="module")
def move(team):
    """`rollout.move` of three missions; without contacts, wheels pull `pull` times as much."""

    @jax.jit
    def of_three(states, pull):
        model = team.free_arena.model
        model = model.replace(actuator_gainprm=pull * model.actuator_gainprm)
        weaker = replace(team, free_arena=replace(team.free_arena, model=model))
        return move_all(weaker, states)

    return lambda states, pull=1.0: of_three(states, jnp.float32(pull))


def way(before, after):
    """How far the camera robots have driven on."""
    return after.scene.poses[:, 0, 0] - before.scene.poses[:, 0, 0]


@pytest.mark.slow  # compiles contacts
def test_contacts_hold_a_robot_back_where_there_are_any(move, pushing):
    free = mission.make_mission(CONFIG, contacts=False)
    ends, start = {}, pushing(0.002, 0.002, 0.002)
    for name, each in (("contacts", move), ("free", jax.jit(lambda s: move_all(free, s)))):
        state = start
        for _ in range(5):
            state = each(state)
        ends[name] = way(pushing(0.0, 0.0, 0.0), state)
        assert np.all(state.contacts > 0)
    # In half a second it drives 10 cm, but for the time it takes to start.
    assert np.all(ends["free"] > 0.08)
    assert np.all(ends["contacts"] < 0.01)


@pytest.mark.slow
def test_where_nothing_can_be_touched_the_empty_arena_gives_the_same_motion(move, pushing):
    # The second robot could touch the PoI, but does not.
    start = pushing(0.05, 0.022, 0.002)
    empty, full, _ = way(start, move(start))
    assert empty > 1e-3
    np.testing.assert_allclose(empty, full, atol=1e-6)
    # The empty arena is used where nothing can be touched, and nowhere else: without the pull of
    # its wheels, a robot stays.
    empty, *full = way(start, move(start, pull=0.0))
    assert empty < 1e-3
    assert full[0] > 1e-2
    assert full[1] > 1e-3
