"""Hand-written rules for teams, against values worked by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsense.dqn import rules
from jaxsense.dqn.team_mdp import Team

RULES = (rules.nearest, rules.auction, rules.gain_rate)


def team(num_robots, num_pois=3, target=None, works=None, present=None):
    """The places are of no importance to the rules."""
    return Team(
        positions=jnp.zeros((num_pois, 2)),
        present=jnp.ones(num_pois, bool) if present is None else jnp.array(present, bool),
        poses=jnp.zeros((num_robots, 3)),
        modality=jnp.zeros(num_robots, int),
        works=jnp.ones(num_robots, bool) if works is None else jnp.array(works, bool),
        target=jnp.array([num_pois] * num_robots if target is None else target),
    )


def choice(rule, gains, times, agent=0, **of_team):
    """The action of the highest value."""
    gains, times = jnp.array(gains, jnp.float32), jnp.array(times, jnp.float32)
    values = jax.jit(rule)(gains, times, team(*gains.shape, **of_team), jnp.int32(agent))
    assert values.shape == (gains.shape[1] + 1,)
    assert values[-1] == 0
    return int(jnp.argmax(values))


ALIKE = np.ones((2, 3))


@pytest.mark.parametrize(
    ("times", "gains", "target", "expected"),
    [
        ([5, 3, 9], [1, 1, 1], 3, 1),
        ([5, 3, 9], [1, 0, 1], 3, 0),  # of PoI 1 nothing is to be learned
        ([5, 3, 9], [0.01, -1, 5], 3, 0),  # how much counts for nothing
        ([5, 3, 9], [1, 1, 1], 1, 0),  # the other robot heads for PoI 1
        ([5, 3, 9], [-1, 1, 0], 1, 1),  # but nothing else is left
        ([90, 3, 99], [1, 1, 1], 1, 0),  # 90 s are less than the 3 + 100 of what is taken
        ([5, 3, 9], [0, -1, -2], 3, 3),  # nothing useful: NOP
        ([5000, 3000, 9000], [1, 1, 1], 3, 1),  # however far
    ],
)
def test_nearest(times, gains, target, expected):
    found = choice(rules.nearest, [gains, ALIKE[1]], [times, [1, 1, 1]], target=[3, target])
    assert found == expected


@pytest.mark.parametrize(
    ("times", "gains", "target", "expected"),
    [
        ([4, 2, 8], [0.8, 0.3, 0.8], 3, 0),  # .2, .15 and .1 in a second
        ([4, 1, 8], [0.8, 0.3, 0.8], 3, 1),  # .2, .3 and .1
        ([4, 2, 8], [0.8, 0.3, 0.8], 0, 1),  # PoI 0 is taken: .8 / 104
        ([4, 2, 8], [0.8, -0.3, 0.0], 0, 0),  # but nothing else is left
        ([4, 2, 8], [-0.8, 0.0, -0.8], 3, 3),
    ],
)
def test_gain_rate(times, gains, target, expected):
    found = choice(rules.gain_rate, [gains, ALIKE[1]], [times, [1, 1, 1]], target=[3, target])
    assert found == expected


def test_values_of_rules_as_worked_by_hand():
    gains, times = jnp.array([[0.8, 0.3, -1.0]]), jnp.array([[4.0, 2.0, 1.0]])
    one = team(1)
    found = rules.nearest(gains, times, one, jnp.int32(0))
    # 1 / (1 + seconds)
    np.testing.assert_allclose(found, [1 / 5, 1 / 3, -1, 0], rtol=1e-6)
    found = rules.gain_rate(gains, times, one, jnp.int32(0))
    np.testing.assert_allclose(found, [0.2, 0.15, -1, 0], rtol=1e-6)
    # The auction's PoI is worth 1 more than in `nearest`.
    found = rules.auction(gains, times, one, jnp.int32(0))
    np.testing.assert_allclose(found, [1 / 5, 4 / 3, -1, 0], rtol=1e-6)


def test_in_an_auction_the_nearest_poi_goes_to_who_is_nearer():
    times = [[2, 4, 9], [1, 5, 9]]
    # Robot 1 wins PoI 0 with the lowest bid, 1 s, and robot 0 is left with PoI 1 for 4 s.
    assert choice(rules.auction, ALIKE, times, agent=0) == 1
    assert choice(rules.auction, ALIKE, times, agent=1) == 0
    assert choice(rules.nearest, ALIKE, times, agent=0) == 0


def test_an_auction_of_three_as_worked_by_hand():
    times = [[3, 4, 5], [2, 6, 7], [2.5, 3.5, 8]]
    # 2 s: robot 1 wins PoI 0. Of the rest 3.5 s: robot 2 wins PoI 1. Then robot 0 PoI 2 for 5 s.
    assert [choice(rules.auction, np.ones((3, 3)), times, agent=i) for i in range(3)] == [2, 0, 1]


def test_with_more_robots_than_pois_the_others_go_to_the_nearest():
    times = [[3, 4], [2, 6], [1, 5]]
    # Robot 2 wins PoI 0, robot 0 PoI 1, and robot 1 nothing.
    assert [choice(rules.auction, np.ones((3, 2)), times, agent=i) for i in range(3)] == [1, 0, 0]
    # Where the winner of PoI 0 already heads for it, there is another one to go to.
    heading = [2, 2, 0]
    assert choice(rules.auction, np.ones((3, 2)), times, agent=1, target=heading) == 1


def test_who_has_nothing_to_learn_or_has_ended_does_not_bid():
    times = [[2, 4, 9], [1, 5, 9]]
    assert choice(rules.auction, [[1, 1, 1], [0, 1, 1]], times) == 0
    assert choice(rules.auction, ALIKE, times, works=[True, False]) == 0


def test_what_a_robot_that_has_ended_headed_for_is_free():
    for rule in (rules.nearest, rules.gain_rate):
        times = [[2, 4, 9], [1, 1, 1]]
        assert choice(rule, ALIKE, times, target=[3, 0]) == 1
        assert choice(rule, ALIKE, times, target=[3, 0], works=[True, False]) == 0
        # The robot's own target is taken by nobody.
        assert choice(rule, ALIKE, times, target=[0, 3]) == 0


@pytest.mark.parametrize("rule", RULES)
def test_absent_pois_are_left_out(rule):
    times = [[2, 4, 9], [8, 8, 8]]
    assert choice(rule, ALIKE, times, present=[0, 1, 1]) == 1
    assert choice(rule, ALIKE, times, present=[0, 0, 0]) == 3


@pytest.mark.parametrize("rule", RULES)
def test_where_nothing_is_useful_all_end(rule):
    assert choice(rule, [[0, -1, 0], [1, 1, 1]], [[1, 2, 3], [4, 5, 6]]) == 3
