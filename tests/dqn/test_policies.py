"""The table of policies, on values worked by hand."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from toys import known_of, policy

from jaxsense.config import ConfigError
from jaxsense.core.types import Belief, pytree
from jaxsense.dqn import optimum, policies
from jaxsense.dqn.agent import Agent
from jaxsense.dqn.optimum import LookValues
from jaxsense.dqn.team import Team

NOP, KEY, UNKNOWN = 3, jax.random.key(0), np.zeros((3, 3))
# The logarithm of what is not so.
NO = -np.inf
ROUND, EDGY = [np.log(0.5), np.log(0.5), NO], [NO, NO, 0.0]


@pytree
class OnMap:
    """A fusion whose beliefs hold the classes' probabilities as their mean."""

    def class_probabilities(self, belief):
        return belief.mean


def linear(of_classes, unseen):
    """A table of `[P]` means of the rewards of three classes, and that of an unseen PoI."""
    points = jnp.array(optimum.lattice(3, 66), jnp.float32)
    return points @ jnp.array(of_classes, jnp.float32), jnp.float32(unseen)


def worthless():
    return linear([-1, -1, -1], -1)


def look_values(q, one_step=None):
    (one, one_unseen), (total, unseen) = one_step or worthless(), q
    return LookValues(one, total, one_unseen, unseen)


@pytest.mark.parametrize(
    ("of_classes", "unseen", "expected", "first"),
    [
        # Unseen: (1 - 2 + 4) / 3 = 1. Seen round, class 0 or 1: (1 - 2) / 2. Seen edgy: 4.
        ((1.0, -2.0, 4.0), 1.0, 2, 0),
        # Unseen: (4 - 2 - 8) / 3 = -2. Seen round: (4 - 2) / 2 = 1. Seen edgy: -8.
        ((4.0, -2.0, -8.0), -2.0, 1, 1),
        # Nothing pays.
        ((-1.0, 0.5, -3.0), -1.2, NOP, NOP),
        # The first look at a PoI has a value of its own.
        ((-1.0, 0.5, -3.0), 0.1, 0, 0),
    ],
)
@pytest.mark.parametrize("modality", [0, 1])
def test_optimal_averages_over_the_classes_that_the_looks_leave_open(
    of_classes, unseen, expected, first, modality
):
    known = known_of([[np.log(1 / 3)] * 3, ROUND, EDGY], [(0, 0), (0, 1), (0, 1)], modality)
    own, other = look_values(linear(of_classes, unseen)), look_values(worthless())
    models = (own, other) if modality == 0 else (other, own)
    assert policy("optimal", look_values=models)(KEY, known) == expected
    # `bayes` reads the reward of the next look alone; all are equally near.
    short = look_values(worthless(), linear(of_classes, unseen))
    models = (short, other) if modality == 0 else (other, short)
    assert policy("bayes", look_values=models)(KEY, known) == first
    assert policy("optimal", look_values=models)(KEY, known) == NOP


def test_greedy_reads_the_map_where_bayes_reads_the_exact_posterior():
    values = look_values(worthless(), linear((1.0, -2.0, 4.0), -1.0))
    models = {"look_values": (values, look_values(worthless())), "fusion": OnMap()}
    on_map = Belief(jnp.array([[0.5, 0.5, 0], [0, 0, 1.0], [0, 1.0, 0]]), jnp.ones((3, 3)))
    known = known_of([EDGY, ROUND, ROUND], np.ones((3, 2)), 0, on_map)
    assert policy("greedy", **models)(KEY, known) == 1
    assert policy("bayes", **models)(KEY, known) == 0
    # The other sensor has other values.
    known = known_of([EDGY, ROUND, ROUND], np.ones((3, 2)), 1, on_map)
    assert policy("greedy", **models)(KEY, known) == NOP


def test_random_takes_every_action_equally_often():
    keys, known = jax.random.split(KEY, 4000), known_of(UNKNOWN, np.zeros((3, 2)))
    actions = jax.vmap(policy("random"), in_axes=(0, None))(keys, known)
    # 1000 each +- 4 sqrt(4000 x 3/16) = +- 110.
    np.testing.assert_allclose(np.bincount(actions, minlength=4), 1000, atol=110)


def test_latent_takes_the_action_that_the_own_q_network_values_most(monkeypatch):
    monkeypatch.setattr(Agent, "values", lambda agent, params, observed, exists: params)
    agent, classes = Agent(0.5, 0.0, None, 3, 2, 2, (4,)), Belief(*jnp.ones((2, 5, 2)))
    models = {"agent": agent, "fusion": SimpleNamespace(classes=classes)}
    for best in range(4):
        networks = jax.nn.one_hot(best, 4), jax.nn.one_hot((best + 1) % 4, 4)
        for modality in (0, 1):
            known = known_of(UNKNOWN, np.zeros((3, 2)), modality)
            assert (
                policy("latent", **models, q_networks=networks)(KEY, known) == (best + modality) % 4
            )


def test_a_dense_network_is_shown_a_poi_that_was_given_up_as_of_the_nearest_class(monkeypatch):
    agent = Agent(0.5, 0.0, None, 3, 2, 1, (4,))
    monkeypatch.setattr(Agent, "values", lambda agent, params, observed, exists: observed)
    classes = Belief(jnp.array([[0.0], [4.0]]), jnp.array([[0.25], [0.75]]))
    belief = Belief(jnp.array([[1.0], [3.0], [5.0]]), jnp.array([[2.0], [4.0], [8.0]]))
    known = known_of(UNKNOWN, np.zeros((3, 2)), belief=belief)
    there = known.team.replace(present=jnp.array([True, False, True]))
    models = SimpleNamespace(
        agent=agent, q_networks=(jnp.zeros(1),) * 2, fusion=SimpleNamespace(classes=classes)
    )
    found = policies.latent(KEY, models, known.replace(team=there))
    np.testing.assert_allclose(found, [1, 2, 4, 0.75, 5, 8])


def test_a_policy_of_ones_own_is_one_more_entry():
    def backwards(key, models, known):
        return jnp.append(jnp.arange(len(known.looks)), -1)

    table = policies.table({"backwards": backwards})
    assert [*table] == [*policies.POLICIES, "backwards"]
    known = known_of(UNKNOWN, np.zeros((3, 2)))
    assert policies.best(table["backwards"](KEY, None, known)) == 2
    with pytest.raises(ConfigError, match=r"^policies = 'greedy': must not be latent, "):
        policies.table({"greedy": backwards})


def known_by(agent, times, target=None, works=None, present=None):
    """What a robot of a team knows; places and looks are of no importance to the rules."""
    num_robots, num_pois = times.shape
    team = Team(
        positions=jnp.zeros((num_pois, 2)),
        present=jnp.ones(num_pois, bool) if present is None else jnp.array(present, bool),
        poses=jnp.zeros((num_robots, 3)),
        modality=jnp.zeros(num_robots, int),
        works=jnp.ones(num_robots, bool) if works is None else jnp.array(works, bool),
        target=jnp.array([num_pois] * num_robots if target is None else target),
    )
    known = known_of(UNKNOWN, np.zeros((num_pois, 2)))
    return known.replace(team=team, times=times, robot=jnp.int32(agent))


def choice(rule, gains, times, agent=0, **of_team):
    """The action of the highest value."""
    gains, times = jnp.array(gains, jnp.float32), jnp.array(times, jnp.float32)
    values = jax.jit(rule)(gains, known_by(agent, times, **of_team))
    assert values.shape == (gains.shape[1] + 1,)
    assert values[-1] == 0
    return int(jnp.argmax(values))


ALIKE = np.ones((2, 3))


NEAREST, RATE = policies.nearest, policies.gain_rate


@pytest.mark.parametrize(
    ("rule", "times", "gains", "target", "expected"),
    [
        (NEAREST, [5, 3, 9], [1, 1, 1], 3, 1),
        (NEAREST, [5, 3, 9], [1, 0, 1], 3, 0),  # of PoI 1 nothing is to be learned
        (NEAREST, [5, 3, 9], [0.01, -1, 5], 3, 0),  # how much counts for nothing
        (NEAREST, [5, 3, 9], [1, 1, 1], 1, 0),  # the other robot heads for PoI 1
        (NEAREST, [5, 3, 9], [-1, 1, 0], 1, 1),  # but nothing else is left
        (NEAREST, [90, 3, 99], [1, 1, 1], 1, 0),  # 90 s are less than the 3 + 100 of what is taken
        (NEAREST, [5, 3, 9], [0, -1, -2], 3, 3),  # nothing useful: NOP
        (NEAREST, [5000, 3000, 9000], [1, 1, 1], 3, 1),  # however far
        (RATE, [4, 2, 8], [0.8, 0.3, 0.8], 3, 0),  # .2, .15 and .1 in a second
        (RATE, [4, 1, 8], [0.8, 0.3, 0.8], 3, 1),  # .2, .3 and .1
        (RATE, [4, 2, 8], [0.8, 0.3, 0.8], 0, 1),  # PoI 0 is taken: .8 / 104
        (RATE, [4, 2, 8], [0.8, -0.3, 0.0], 0, 0),  # but nothing else is left
        (RATE, [4, 2, 8], [-0.8, 0.0, -0.8], 3, 3),
    ],
)
def test_choices_of_a_robot_by_its_times_and_gains(rule, times, gains, target, expected):
    assert choice(rule, [gains, ALIKE[1]], [times, [1, 1, 1]], target=[3, target]) == expected


def test_values_of_rules_as_worked_by_hand():
    gains, times = jnp.array([[0.8, 0.3, -1.0]]), jnp.array([[4.0, 2.0, 1.0]])
    # 1 / (1 + seconds); the auction's PoI is worth 1 more than in `nearest`.
    for rule, expected in (
        (NEAREST, [1 / 5, 1 / 3, -1, 0]),
        (policies.auction, [1 / 5, 4 / 3, -1, 0]),
        (RATE, [0.2, 0.15, -1, 0]),
    ):
        np.testing.assert_allclose(rule(gains, known_by(0, times)), expected, rtol=1e-6)


def test_auctions_as_worked_by_hand():
    # 1 s: robot 1 wins PoI 0, and robot 0 is left with PoI 1 for 4 s, though PoI 0 is nearer.
    times = [[2, 4, 9], [1, 5, 9]]
    assert [choice(policies.auction, ALIKE, times, agent=i) for i in range(2)] == [1, 0]
    assert choice(policies.nearest, ALIKE, times) == 0
    # 2 s: robot 1 wins PoI 0. Of the rest 3.5 s: robot 2 wins PoI 1. Then robot 0 PoI 2 for 5 s.
    times, ones = [[3, 4, 5], [2, 6, 7], [2.5, 3.5, 8]], np.ones((3, 3))
    assert [choice(policies.auction, ones, times, agent=i) for i in range(3)] == [2, 0, 1]
    times = [[3, 4], [2, 6], [1, 5]]
    ones = np.ones((3, 2))
    # Robot 2 wins PoI 0, robot 0 PoI 1, and robot 1 nothing: it goes to the nearest.
    assert [choice(policies.auction, ones, times, agent=i) for i in range(3)] == [1, 0, 0]
    # Where the winner of PoI 0 already heads for it, there is another one to go to.
    assert choice(policies.auction, ones, times, agent=1, target=[2, 2, 0]) == 1


def test_who_has_nothing_to_learn_or_has_ended_does_not_bid():
    times = [[2, 4, 9], [1, 5, 9]]
    assert choice(policies.auction, [[1, 1, 1], [0, 1, 1]], times) == 0
    assert choice(policies.auction, ALIKE, times, works=[True, False]) == 0


def test_what_a_robot_that_has_ended_headed_for_is_free():
    for rule in (NEAREST, RATE):
        times = [[2, 4, 9], [1, 1, 1]]
        assert choice(rule, ALIKE, times, target=[3, 0]) == 1
        assert choice(rule, ALIKE, times, target=[3, 0], works=[True, False]) == 0
        # The robot's own target is taken by nobody.
        assert choice(rule, ALIKE, times, target=[0, 3]) == 0


@pytest.mark.parametrize("rule", [NEAREST, policies.auction, RATE])
def test_absent_pois_are_left_out(rule):
    times = [[2, 4, 9], [8, 8, 8]]
    assert choice(rule, ALIKE, times, present=[0, 1, 1]) == 1
    assert choice(rule, ALIKE, times, present=[0, 0, 0]) == 3
