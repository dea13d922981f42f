"""Which PoI a robot takes, by policies whose values are known."""

import itertools
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from teams import CONFIG, LATENT, NAIVE, POSES, POSITIONS, with_values

import jaxsense
from jaxsense.mission import decide
from jaxsense.mission.state import DRIVING, ENDED, FACING, IDLE


@pytest.fixture(scope="module")
def chosen(decides, models, arena_of):
    def choose(values, policy=LATENT, change=lambda state: state):
        state = change(arena_of(POSITIONS, POSES, policy=policy))
        return decides(with_values(models, values, values), state)

    return choose


def seen_by(own, other=(0, 0, 0)):
    """How often the robot under test has seen each PoI, and how often the other one has."""
    return lambda state: replace(state, times_seen=jnp.array([own, other], jnp.int32).T)


@pytest.mark.parametrize(
    ("values", "target"),
    [
        ([1.0, 0.5, 0.0, 0.0], 0),
        ([1.0, 0.99, 1.01, 0.0], 2),  # the farthest, if the network says so
        ([-0.2, 0.3, 0.1, 0.2], 1),
        ([0.1, 0.2, 0.3, 0.31], 3),  # nothing beats NOP
        ([0.5, 0.5, 0.5001, 0.5], 2),
        *((x := np.random.default_rng(seed).normal(size=4), x.argmax()) for seed in range(8)),
    ],
)
def test_the_network_alone_chooses(chosen, set_robot, values, target):
    # Neither who is near, nor where the other robot heads or stands, changes the choice.
    there = jnp.array([[0.0, 0.0, 0.0], [1.5, 0.0, jnp.pi]])
    moved = lambda s: replace(s, scene=replace(s.scene, poses=there))  # noqa: E731
    heading = lambda s: set_robot(s, 1, target=target)  # noqa: E731
    for change in (moved, heading, lambda s: s):
        state = chosen(values, change=change)
        assert state.robots.target[0] == target
        assert state.robots.phase[0] == (ENDED if target == 3 else DRIVING)
    # PoIs 0 and 1 are in view from where the robot stands: nothing to drive to.
    assert state.robots.goals[0] == (target == 2)


def test_a_network_of_teams_chooses_by_what_the_robot_knows(decides, team, arena_of, set_robot):
    config = replace(CONFIG, dqn=replace(CONFIG.dqn, task="team"))
    models, taken = jaxsense.init(jax.random.key(0), config), set()

    @jax.jit
    def values_of(params, state):
        known = decide.known_to(team, models, state, 0)
        seen = models.agent.observe(known.belief, known.team, known.times, 0)
        return models.agent.values(params, seen)

    begun = set_robot(arena_of(POSITIONS, POSES, policy=LATENT), 1, target=1)
    for seed, given_up in itertools.product(range(8), range(3)):
        params = models.agent.init(jax.random.key(seed))
        state = set_robot(begun, 0, undetected=np.arange(3) < given_up)
        target = given_up + int(jnp.argmax(values_of(params, state)[given_up:]))
        assert decides(replace(models, q_networks=(params,)), state).robots.target[0] == target
        taken.add(target)
    assert taken == {0, 1, 2, 3}


def test_a_poi_that_was_given_up_is_left_out(chosen, set_robot):
    given_up = jnp.array([False, True, False])
    for name in ("unreachable", "undetected"):
        state = chosen([0.5, 1.0, 0.4, 0.0], change=lambda s: set_robot(s, 0, **{name: given_up}))  # noqa: B023
        assert state.robots.target[0] == 0
    everything = jnp.ones(3, bool)
    state = chosen([1.0] * 3 + [0.0], change=lambda s: set_robot(s, 0, undetected=everything))
    assert state.robots.phase[0] == ENDED


def without_ways(state):
    """No way to PoI 2."""
    ways = replace(
        state.roadmap,
        is_free=state.roadmap.is_free.at[2].set(False),
        is_next=state.roadmap.is_next.at[2].set(False),
    )
    return replace(state, roadmap=ways)


def test_where_a_robot_was_stuck_it_tries_again_once_before_it_ends(chosen, set_robot):
    given_up = {"unreachable": jnp.array([True, False, True])}

    def at_the_end(tried_again):
        values = [1.0, 0.0, 1.0, 0.5]  # nothing to learn at PoI 1
        change = lambda s: without_ways(set_robot(s, 0, tried_again=tried_again, **given_up))  # noqa: E731
        return jax.tree.map(lambda x: x[0], chosen(values, change=change).robots)

    first, second = at_the_end(jnp.bool_(False)), at_the_end(jnp.bool_(True))
    assert (first.phase, second.phase) == (IDLE, ENDED)
    np.testing.assert_array_equal(first.unreachable, [False, False, True])
    np.testing.assert_array_equal(second.unreachable, given_up["unreachable"])
    assert first.tried_again


@pytest.mark.parametrize("phase", [DRIVING, FACING])
@pytest.mark.parametrize("policy", [LATENT, NAIVE])
@pytest.mark.parametrize(("decided_on", "target"), [(0, 2), (2, 0)])
def test_a_changed_map_makes_a_robot_decide_again(
    chosen, set_robot, phase, policy, decided_on, target
):
    some = np.arange(33) < 3  # of the viewpoints

    def under_way(state):
        # Of the naive policy only PoI 2 is left, which is the best of the latent one.
        own = {"phase": phase, "target": 0, "goals": 1, "attempts": 1, "excluded": some}
        return set_robot(seen_by([1, 1, 0])(state), 0, **own, decided_on=decided_on)

    state = chosen([0.0, 0.0, 1.0, 0.5], policy, under_way)
    assert state.robots.target[0] == target
    if target == 2:
        assert state.robots.phase[0] == DRIVING
        # The goal under way was needless, the new one counts; what was reached was reached.
        assert state.robots.goals[0] == (1 if phase == DRIVING else 2)
        assert state.robots.attempts[0] == state.robots.excluded[0].sum() == 0
    else:
        assert state.robots.phase[0] == phase
        assert state.robots.goals[0] == 1


def test_a_robot_that_sees_the_poi_looks_from_where_it_stands(chosen):
    # PoI 1 is 0.8 m away and in full view; V is the place where the robot stands.
    state = chosen([0.0, 1.0, 0.0, 0.0])
    assert state.robots.view[0] == state.roadmap.viewpoints.shape[1]
    assert state.robots.path_left[0] == 0
    # Unless another robot stands in the view.
    poses = jnp.array([[0.0, 0.0, 0.0], [0.0, 0.4, 0.0]])
    hidden = lambda s: replace(s, scene=replace(s.scene, poses=poses))  # noqa: E731
    assert chosen([0.0, 1.0, 0.0, 0.0], change=hidden).robots.view[0] < state.robots.view[0]
    # PoI 2 is 1.6 m away: .7 m to where it sees it from .9 m.
    state = chosen([0.0, 0.0, 1.0, 0.0], change=lambda s: replace(s, steps=jnp.int32(50)))
    assert state.robots.path_left[0] == pytest.approx(0.7, abs=0.05)
    assert state.robots.progress_at[0] == state.time


def test_a_robot_goes_on_to_its_viewpoint_if_its_target_stays(chosen, set_robot):
    own = {"phase": DRIVING, "target": 2, "view": 5, "goals": 1, "path_left": 0.75}
    change = lambda s: set_robot(seen_by([1, 1, 0])(s), 0, **own)  # noqa: E731
    robots = chosen([0.0, 0.0, 1.0, 0.5], change=change).robots
    assert robots.decided_on[0] == 2
    assert {name: getattr(robots, name)[0] for name in own} == own


def test_a_robot_that_has_ended_works_no_more(team, models, arena_of, set_robot):
    state = set_robot(arena_of(POSITIONS, POSES), 1, phase=ENDED)
    known = jax.jit(lambda state: decide.known_to(team, models, state, 0).team.works)
    np.testing.assert_array_equal(known(state), [True, False])


def test_a_poi_without_any_viewpoint_is_given_up(chosen):
    state = chosen([0.0, 0.0, 1.0, 0.5], change=without_ways)
    assert state.robots.phase[0] == IDLE
    np.testing.assert_array_equal(state.robots.unreachable[0], [False, False, True])
    # A goal that was not reached.
    assert (state.robots.goals[0], state.robots.reached[0]) == (1, 0)
