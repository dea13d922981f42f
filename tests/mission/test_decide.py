"""Which PoI a robot takes, by policies whose values are known."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from teams import with_values

from jaxsense import mission
from jaxsense.mission import decide
from jaxsense.mission.state import BACKING, DRIVING, ENDED, FACING, IDLE
from jaxsense.types import Belief

# The robot is 1.0, 0.8 and 1.6 m from PoIs 0, 1 and 2.
POSITIONS = [[1.0, 0.0], [0.0, 0.8], [-1.0, -1.25]]
POSES = [[0.0, 0.0, 0.0], [1.2, 1.2, 0.0]]
SURE = Belief(jnp.array([[3.0, 0.0], [-2.0, 0.0], [0.0, 2.0]]), jnp.full((3, 2), 0.25))


@pytest.fixture(scope="module")
def decides(team):
    return jax.jit(lambda key, models, state: decide.decide(key, team, models, state, 0))


@pytest.fixture(scope="module")
def chosen(decides, models, arena_of):
    def choose(values, policy=mission.LATENT, change=lambda state: state):
        state = change(arena_of(POSITIONS, POSES, policy=policy))
        return decides(jax.random.key(0), with_values(models, values, values), state)

    return choose


@pytest.mark.parametrize(
    ("values", "target"),
    [
        ([1.0, 0.5, 0.0, 0.0], 0),  # the best
        ([1.0, 0.95, 0.0, 0.0], 1),  # within .1 of the best, and nearer
        ([1.0, 0.95, 1.0, 0.0], 1),
        ([1.0, 0.85, 1.0, 0.0], 0),  # PoI 1 is too bad, PoI 2 too far
        ([-0.2, 0.1, 0.3, 0.2], 2),  # nearer PoI 1 is within .2, not within .1
    ],
)
def test_of_values_within_the_tolerance_the_nearest_is_taken(chosen, values, target):
    state = chosen(values)
    assert state.robots.target[0] == target
    assert state.robots.phase[0] == DRIVING
    # PoIs 0 and 1 are in view from where the robot stands: nothing to drive to.
    assert state.robots.goals[0] == (target == 2)


def test_when_nothing_beats_nop_the_robot_ends(chosen):
    state = chosen([0.1, 0.2, 0.3, 0.3])
    assert state.robots.phase[0] == ENDED
    assert state.robots.target[0] == 3
    assert state.robots.goals[0] == 0


def test_of_equal_values_the_one_that_nobody_heads_for_is_taken(chosen, set_robot):
    state = chosen([1.0] * 3 + [0.0], change=lambda s: set_robot(s, 1, target=1))
    assert state.robots.target[0] == 0


def test_a_poi_that_was_given_up_is_left_out(chosen, set_robot):
    given_up = jnp.array([False, True, False])
    for name in ("unreachable", "undetected"):
        state = chosen([0.5, 1.0, 0.4, 0.0], change=lambda s: set_robot(s, 0, **{name: given_up}))  # noqa: B023
        assert state.robots.target[0] == 0
    everything = jnp.ones(3, bool)
    state = chosen([1.0] * 3 + [0.0], change=lambda s: set_robot(s, 0, undetected=everything))
    assert state.robots.phase[0] == ENDED


def test_naive_takes_the_nearest_that_its_own_sensor_has_not_seen(chosen):
    useless = [0.0] * 4
    assert chosen(useless, mission.NAIVE).robots.target[0] == 1

    def seen_by(own, other):
        seen = jnp.array([own, other]).T
        return lambda state: replace(state, seen=seen)

    nobody = [False] * 3
    after_first = chosen(useless, mission.NAIVE, seen_by([False, True, False], nobody))
    assert after_first.robots.target[0] == 0
    after_others = chosen(useless, mission.NAIVE, seen_by(nobody, [True] * 3))
    assert after_others.robots.target[0] == 1
    after_all = chosen(useless, mission.NAIVE, seen_by([True] * 3, nobody))
    assert after_all.robots.phase[0] == ENDED


def test_random_takes_every_poi_and_nop_equally_often(team, models, arena_of):
    state = arena_of(POSITIONS, POSES, policy=mission.RANDOM)
    choose = jax.jit(
        jax.vmap(lambda key: decide.decide(key, team, models, state, 0).robots.target[0])
    )
    targets = choose(jax.random.split(jax.random.key(0), 2000))
    shares = np.bincount(targets, minlength=4) / 2000
    # Four standard errors of a share of 1/4.
    np.testing.assert_allclose(shares, 0.25, atol=4 * np.sqrt(0.25 * 0.75 / 2000))


@pytest.mark.parametrize("phase", [DRIVING, FACING])
@pytest.mark.parametrize(
    ("policy", "version", "target"),
    [(mission.LATENT, 1, 2), (mission.LATENT, 0, 0), (mission.NAIVE, 1, 0)],
)
def test_a_changed_map_makes_the_latent_policy_decide_again(
    chosen, set_robot, phase, policy, version, target
):
    def under_way(state):
        state = replace(state, version=jnp.int32(version))
        return set_robot(state, 0, phase=phase, target=0, goals=1, attempts=1)

    state = chosen([0.0, 0.0, 1.0, 0.5], policy, under_way)
    assert state.robots.target[0] == target
    if target == 2:
        assert state.robots.phase[0] == DRIVING
        # The goal under way was needless, the new one counts; what was reached was reached.
        assert state.robots.goals[0] == (1 if phase == DRIVING else 2)
        assert state.robots.attempts[0] == 0
    else:
        assert state.robots.phase[0] == phase
        assert state.robots.goals[0] == 1


def test_a_target_of_equal_value_is_kept(chosen, set_robot):
    def under_way(state):
        state = replace(state, version=jnp.int32(1))
        return set_robot(state, 0, phase=DRIVING, target=2, goals=1)

    state = chosen([1.0, 1.0, 0.95, 0.0], change=under_way)
    assert state.robots.target[0] == 2
    assert state.robots.goals[0] == 1


@pytest.mark.parametrize("phase", [BACKING, ENDED])
def test_a_robot_that_backs_off_or_has_ended_does_not_decide(chosen, set_robot, phase):
    state = chosen([1.0] * 3 + [0.0], change=lambda s: set_robot(s, 0, phase=phase, target=2))
    assert state.robots.phase[0] == phase
    assert state.robots.target[0] == 2


def test_a_robot_that_sees_the_poi_looks_from_where_it_stands(chosen):
    # PoI 1 is 0.8 m away and in full view; V is the place where the robot stands.
    state = chosen([0.0, 1.0, 0.0, 0.0])
    assert state.robots.view[0] == state.roadmap.viewpoints.shape[1]
    assert state.robots.way_left[0] == 0
    # PoI 2 is 1.6 m away.
    assert chosen([0.0, 0.0, 1.0, 0.0]).robots.view[0] < state.roadmap.viewpoints.shape[1]


def test_a_poi_without_any_viewpoint_is_given_up(chosen):
    def without_ways(state):
        ways = replace(
            state.roadmap,
            is_free=state.roadmap.is_free.at[2].set(False),
            to_viewpoint=state.roadmap.to_viewpoint.at[2].set(jnp.inf),
        )
        return replace(state, roadmap=ways)

    state = chosen([0.0, 0.0, 1.0, 0.5], change=without_ways)
    assert state.robots.phase[0] == IDLE
    np.testing.assert_array_equal(state.robots.unreachable[0], [False, False, True])
    # A goal that was not reached.
    assert (state.robots.goals[0], state.robots.reached[0]) == (1, 0)


def hoping(network, poi, entry, others):
    """A Q-network for which looking at a PoI is worth the positive part of an entry of the map.

    The other PoIs and NOP are of the values [N + 1] in `others`.
    """
    layers = jax.tree.map(jnp.zeros_like, network)["params"]
    first, *_, last = sorted(layers)
    for name, layer in layers.items():
        row, column = entry if name == first else 0, poi if name == last else 0
        layer["kernel"] = layer["kernel"].at[row, column].set(1.0)
    layers[last]["bias"] = jnp.array(others, jnp.float32)
    return {"params": layers}


@pytest.fixture
def after_giving_up(decides, models, arena_of, set_robot):
    """The PoI that a robot takes which gave PoI 1 up, and hopes for PoI 0 by an entry of PoI 1."""

    def choose(entry, others, sure=SURE):
        networks = tuple(hoping(n, 0, 4 + entry, others) for n in models.q_networks)
        trained = replace(models, class_beliefs=sure, q_networks=networks)
        state = arena_of(POSITIONS, POSES, policy=mission.LATENT)
        state = set_robot(state, 0, undetected=jnp.array([False, True, False]))
        return int(decides(jax.random.key(0), trained, state).robots.target[0])

    return choose


@pytest.mark.parametrize("turn", [0, 1, 2])
@pytest.mark.parametrize(("other", "expected"), [(0.85, 0), (1.15, 2)])
def test_what_was_given_up_is_of_every_class_alike(after_giving_up, turn, other, expected):
    # The first number of its entry is 3, -2 or 0 in the classes: a look at PoI 0 is worth (3 + 0 +
    # 0) / 3 = 1, in whatever order they come. 0.1 counts as equally good, and PoI 0 is nearer.
    sure = jax.tree.map(lambda x: jnp.roll(x, turn, axis=0), SURE)
    assert after_giving_up(0, [0.0, 0.0, other, 0.0], sure) == expected


@pytest.mark.parametrize(("other", "expected"), [(0.1, 0), (0.4, 2)])
def test_of_what_was_given_up_nothing_is_left_to_learn(after_giving_up, other, expected):
    # Its standard deviation is 0.25, that of what is known, not 4.5, that of what nobody has seen.
    assert after_giving_up(2, [0.0, 0.0, other, 0.0]) == expected
