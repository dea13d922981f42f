"""Physics of a control period, with contacts and without."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from teams import AHEAD, CONFIG

from jaxsense import mission
from jaxsense.mission.rollout import _is_near
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
            states.append(set_robot(state, 0, command=speed))
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
        return move_all(weaker, states, states.robots.command)

    return lambda states, pull=1.0: of_three(states, jnp.float32(pull))


def way(before, after):
    """How far the camera robots have driven on."""
    return after.scene.poses[:, 0, 0] - before.scene.poses[:, 0, 0]


def test_contacts_are_simulated_where_anything_can_be_touched(arena_of):
    layout = arena_of(AHEAD, [[0.0, 0.0, 0.0], [0.0, 1.2, 0.0]]).scene.layout
    # Gaps to the wall and between the robots: each drives .02 m, and may be .005 m ahead of that.
    gaps = np.array([[0.024, 1.0], [0.026, 1.0], [1.0, 0.044], [1.0, 0.046]])
    first = 1.5 - amiro.BODY_RADIUS - gaps[:, 0]
    x = np.stack([first, first - 2 * amiro.BODY_RADIUS - gaps[:, 1]], axis=1)
    poses = jnp.array(np.stack([x, np.full_like(x, 0.4), np.zeros_like(x)], axis=-1), jnp.float32)
    layouts = jax.tree.map(lambda x: jnp.stack([x] * 4), layout)
    near = jax.jit(lambda layouts, poses: _is_near(CONFIG, layouts, poses))(layouts, poses)
    np.testing.assert_array_equal(near, [True, False, True, False])


def test_periods_of_contact_are_counted(team, pushing, monkeypatch):
    # Without the physics, which takes long to compile: clear of everything, and in contact.
    clearance = lambda *given: (given[2], given[2].poses[:, 0, 0] - 0.6)  # noqa: E731
    monkeypatch.setitem(_is_near.__globals__, "_integrate", clearance)
    before = replace(pushing(0.03, 0.1), contacts=jnp.array([2, 2], jnp.int32))
    after = jax.jit(lambda states: move_all(team, states, states.robots.command))(before)
    np.testing.assert_array_equal(after.contacts, [2, 3])


@pytest.mark.slow  # compiles contacts
def test_contacts_hold_a_robot_back_where_there_are_any(move, pushing):
    free = mission.make_mission(CONFIG, contacts=False)
    ends, start = {}, pushing(0.002, 0.002, 0.002)
    for name, each in (
        ("contacts", move),
        ("free", jax.jit(lambda s: move_all(free, s, s.robots.command))),
    ):
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
