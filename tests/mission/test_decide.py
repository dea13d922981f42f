"""Which PoI a robot takes, by policies whose values are known."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from teams import (
    LATENT,
    NAIVE,
    POLICIES,
    POSES,
    POSITIONS,
    with_class_beliefs,
    with_values,
)

from jaxsense.core.types import Belief
from jaxsense.dqn import optimum
from jaxsense.dqn.optimum import LookValues
from jaxsense.mission import decide
from jaxsense.mission.state import BACKING, DRIVING, ENDED, FACING, IDLE
from jaxsense.vae import readout

SURE = Belief(jnp.array([[3.0, 0.0], [-2.0, 0.0], [0.0, 2.0]]), jnp.full((3, 2), 0.25))


@pytest.fixture(scope="module")
def chosen(decides, models, arena_of):
    def choose(values, policy=LATENT, change=lambda state: state, **rules):
        state = change(arena_of(POSITIONS, POSES, policy=policy))
        return decides(with_values(models, values, values), state, **rules)

    return choose


def seen_by(own, other=(0, 0, 0)):
    """How often the robot under test has seen each PoI, and how often the other one has."""
    return lambda state: replace(state, times_seen=jnp.array([own, other], jnp.int32).T)


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


@pytest.mark.parametrize(
    ("values", "target"),
    [
        # PoI 0 is straight ahead, 0.04 m from where it is seen; PoI 1 is a quarter turn away.
        ([0.1, 5.0, 0.2, 0.0], 0),
        ([-0.1, 0.2, 5.0, 0.0], 1),
        ([-0.1, -0.2, 5.0, 0.0], 2),
        ([0.5, 0.5, 0.5, 0.6], 3),
    ],
)
def test_in_an_auction_a_robot_takes_what_is_near_of_all_that_pays(chosen, values, target):
    state = chosen(values, auctions=True)
    assert state.robots.target[0] == target
    assert state.robots.phase[0] == (ENDED if target == 3 else DRIVING)


@pytest.mark.parametrize(
    ("values", "target"),
    # The second value is within `equal_values` = 0.1 of the first, whose PoI is nearer.
    [([0.1, 5.0, 0.2, 0.0], 1), ([1.0, 1.05, 0.2, 0.0], 1), ([0.5, 0.5, 0.5, 0.6], 3)],
)
def test_the_network_alone_takes_its_highest_value(chosen, values, target):
    state = chosen(values, POLICIES.index("network"), auctions=True)
    assert state.robots.target[0] == target


def test_in_an_auction_another_robot_takes_what_is_nearer_to_it(chosen, set_robot):
    # The other robot stands on PoI 0's far side, turned towards it.
    there = jnp.array([[0.0, 0.0, 0.0], [1.5, 0.0, jnp.pi]])
    moved = lambda s: replace(s, scene=replace(s.scene, poses=there))  # noqa: E731
    assert chosen([1.0, 1.0, 1.0, 0.0], change=moved, auctions=True).robots.target[0] == 1
    done = lambda s: set_robot(moved(s), 1, phase=ENDED)  # noqa: E731
    assert chosen([1.0, 1.0, 1.0, 0.0], change=done, auctions=True).robots.target[0] == 0


def test_before_its_first_decision_a_robot_has_no_target(arena_of):
    state = arena_of(POSITIONS, POSES)
    np.testing.assert_array_equal(state.robots.phase, [IDLE, IDLE])
    np.testing.assert_array_equal(state.robots.target, [3, 3])


def test_progress_counts_from_the_moment_of_setting_out(chosen):
    later = lambda state: replace(state, steps=jnp.int32(70))  # noqa: E731
    # 70 control periods of 0.1 s, after which a robot that had set out at 0 would count as stuck.
    assert chosen([1.0, 0.0, 0.0, 0.0], change=later).robots.progress_at[0] == pytest.approx(7.0)
    assert chosen([0.0] * 4, change=later).robots.progress_at[0] == 0.0  # it ends


def test_when_nothing_beats_nop_the_robot_ends(chosen):
    state = chosen([0.1, 0.2, 0.3, 0.3])
    assert state.robots.phase[0] == ENDED
    assert state.robots.target[0] == 3
    assert state.robots.goals[0] == 0


@pytest.mark.parametrize("policy", [LATENT, NAIVE])
def test_of_equal_values_the_nearest_is_taken(chosen, policy):
    assert chosen([1.0] * 3 + [0.0], policy).robots.target[0] == 1


@pytest.mark.parametrize("policy", [LATENT, NAIVE])
def test_of_equal_values_the_one_that_nobody_heads_for_is_taken(chosen, set_robot, policy):
    heading = lambda state: set_robot(state, 1, target=1)  # noqa: E731
    assert chosen([1.0] * 3 + [0.0], policy, heading).robots.target[0] == 0


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
        leads=state.roadmap.leads.at[2].set(False),
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


def test_a_robot_under_way_stops_to_try_again(chosen, set_robot):
    given_up = jnp.array([True, False, False])

    def on_its_way(state):
        state = set_robot(state, 0, phase=DRIVING, target=1, goals=1, unreachable=given_up)
        return replace(state, version=jnp.int32(1))

    found = jax.tree.map(lambda x: x[0], chosen([1.0, 0.0, 0.0, 0.5], change=on_its_way).robots)
    assert (found.phase, found.target, found.goals) == (IDLE, 3, 0)
    assert not np.any(found.unreachable)


def test_a_robot_does_not_try_again_while_there_is_something_else(chosen, set_robot):
    given_up = jnp.array([True, False, False])
    state = chosen([1.0, 0.9, 0.0, 0.5], change=lambda s: set_robot(s, 0, unreachable=given_up))
    assert state.robots.target[0] == 1
    np.testing.assert_array_equal(state.robots.unreachable[0], given_up)
    assert not state.robots.tried_again[0]


def test_naive_takes_the_nearest_that_its_own_sensor_has_not_seen(chosen):
    useless = [0.0] * 4
    assert chosen(useless, NAIVE).robots.target[0] == 1
    after_first = chosen(useless, NAIVE, seen_by([0, 1, 0]))
    assert after_first.robots.target[0] == 0
    after_others = chosen(useless, NAIVE, seen_by([0, 0, 0], [1, 1, 1]))
    assert after_others.robots.target[0] == 1
    after_all = chosen(useless, NAIVE, seen_by([1, 1, 1]))
    assert after_all.robots.phase[0] == ENDED


@pytest.mark.parametrize(
    ("times", "targets"),
    [
        # Of what each has not seen often enough, the nearest; PoI 1 is nearer than 0, that than 2.
        ([1, 2, 0], (2, 0, 1)),
        ([1, 1, 1], (3, 1, 1)),
        ([2, 2, 2], (3, 3, 1)),
        ([3, 3, 3], (3, 3, 3)),
    ],
)
def test_naive_policies_look_once_twice_and_three_times(chosen, times, targets):
    for policy, target in zip(("naive", "naive_2", "naive_3"), targets, strict=True):
        # What the other robot has seen does not count.
        state = chosen([0.0] * 4, POLICIES.index(policy), seen_by(times, [3, 0, 3]))
        assert state.robots.target[0] == target


def look_values(gains, totals):
    """Values of looks that are linear in the classes' probabilities, and so exact in a table."""
    points = jnp.array(optimum.lattice(3), jnp.float32)
    # No look at an unseen PoI pays.
    nothing = jnp.float32(-5.0)
    return LookValues(points @ jnp.array(gains), points @ jnp.array(totals), nothing, nothing)


@pytest.fixture(scope="module")
def by_tables(decides, models, arena_of):
    """The robot's choice with a policy that reads tables.

    By the map, PoI n is of class n; by exact Bayes, of the class after that.
    """
    shares = jnp.eye(3)
    belief = jax.vmap(lambda weights: readout.mixture(SURE, weights))(shares)
    posterior = jnp.log(jnp.roll(shares, 1, axis=1) + 1e-6)

    def choose(policy, gains, totals, seen=(1, 1, 1), **first):
        # The other robot's looks would be worth the most at what this one values least.
        own = replace(look_values(gains, totals), **first)
        of_each = own, look_values([-9 * g for g in gains], [9.0, 0.0, 0.0])
        trained = replace(with_class_beliefs(models, SURE), look_values=of_each)
        state = seen_by(seen)(arena_of(POSITIONS, POSES, policy=POLICIES.index(policy)))
        return decides(trained, replace(state, belief=belief, log_posterior=posterior))

    return choose


@pytest.mark.parametrize(
    ("policy", "target"),
    [
        ("greedy", 0),  # which the map takes for class 0, of gain 1
        ("bayes", 2),  # which is of class 0 by exact Bayes
        ("optimal", 1),  # which is of class 2 by exact Bayes, of total 1
    ],
)
def test_policies_with_tables_take_the_look_of_the_highest_value(by_tables, policy, target):
    gains, totals = [1.0, -1.0, 0.5], [-1.0, 0.2, 1.0]
    assert by_tables(policy, gains, totals).robots.target[0] == target
    # What the other table says is of no importance.
    is_of_total = policy == "optimal"
    state = by_tables(policy, *(([0.0] * 3, totals) if is_of_total else (gains, [0.0] * 3)))
    assert state.robots.target[0] == target


@pytest.mark.parametrize("policy", ["greedy", "bayes", "optimal"])
def test_policies_with_tables_end_where_no_look_has_a_value_above_0(by_tables, policy):
    assert by_tables(policy, [-0.1, -1.0, 0.0], [-0.1, -1.0, 0.0]).robots.phase[0] == ENDED
    assert by_tables(policy, [-0.1, -1.0, 0.1], [-0.1, -1.0, 0.1]).robots.phase[0] == DRIVING


@pytest.mark.parametrize("policy", ["greedy", "bayes", "optimal"])
def test_a_poi_that_nobody_has_seen_has_the_value_of_a_first_look(by_tables, policy):
    first = {"q_unseen" if policy == "optimal" else "one_step_unseen": jnp.float32(2.0)}
    values = [1.0, -1.0, 0.5], [-1.0, 0.2, 1.0]
    assert by_tables(policy, *values, seen=(1, 1, 0), **first).robots.target[0] == 2
    assert by_tables(policy, *values, seen=(0, 1, 1), **first).robots.target[0] == 0
    first = {name: jnp.float32(-2.0) for name in first}
    assert by_tables(policy, *values, seen=(0, 0, 0), **first).robots.phase[0] == ENDED


def test_random_takes_every_poi_and_nop_equally_often(team, models, arena_of):
    state = arena_of(POSITIONS, POSES, policy=POLICIES.index("random"))
    choose = jax.jit(
        jax.vmap(lambda key: decide.decide(key, team, models, state, 0).robots.target[0])
    )
    targets = choose(jax.random.split(jax.random.key(0), 2000))
    shares = np.bincount(targets, minlength=4) / 2000
    # Four standard errors of a share of 1/4.
    np.testing.assert_allclose(shares, 0.25, atol=4 * np.sqrt(0.25 * 0.75 / 2000))


@pytest.mark.parametrize("phase", [DRIVING, FACING])
@pytest.mark.parametrize("policy", [LATENT, NAIVE])
@pytest.mark.parametrize(("version", "target"), [(1, 2), (0, 0)])
def test_a_changed_map_makes_a_robot_decide_again(
    chosen, set_robot, phase, policy, version, target
):
    def under_way(state):
        # Of the naive policy only PoI 2 is left, which is the best of the latent one.
        state = seen_by([1, 1, 0])(replace(state, version=jnp.int32(version)))
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
    def change(state):
        everywhere = jnp.ones_like(state.robots.excluded[0])
        return set_robot(state, 0, phase=phase, target=2, excluded=everywhere)

    state = chosen([1.0] * 3 + [0.0], change=change)
    assert state.robots.phase[0] == phase
    assert state.robots.target[0] == 2
    assert state.robots.excluded[0].all()


def test_a_robot_that_sees_the_poi_looks_from_where_it_stands(chosen):
    # PoI 1 is 0.8 m away and in full view; V is the place where the robot stands.
    state = chosen([0.0, 1.0, 0.0, 0.0])
    assert state.robots.view[0] == state.roadmap.viewpoints.shape[1]
    assert state.robots.path_left[0] == 0
    # PoI 2 is 1.6 m away.
    assert chosen([0.0, 0.0, 1.0, 0.0]).robots.view[0] < state.roadmap.viewpoints.shape[1]


def test_a_poi_without_any_viewpoint_is_given_up(chosen):
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
        trained = replace(with_class_beliefs(models, sure), q_networks=networks)
        state = arena_of(POSITIONS, POSES, policy=LATENT)
        state = set_robot(state, 0, undetected=jnp.array([False, True, False]))
        return int(decides(trained, state).robots.target[0])

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
