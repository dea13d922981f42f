"""Trials of choices, with times worked by hand, and what is learned from them."""

import functools
import math
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from toys import Fixed, classes_mdp, team_mdp_of

from jaxsense.config import PRESETS, TeamConfig, ToursConfig
from jaxsense.core import networks, supervised
from jaxsense.core.types import Belief, pytree
from jaxsense.dqn import team_mdp, tours
from jaxsense.dqn.team_agent import TeamAgent
from jaxsense.dqn.team_mdp import Team
from jaxsense.dqn.tours import Trials
from jaxsense.dqn.travel import Travel
from jaxsense.models import init

TRAVEL = Travel(speed=0.2, turn_rate=1.0, view_distance=0.9, look_seconds=1.0)
# In a row, 1.9 and 3.9 m from two robots at the origin; the third is not present.
PLACES = jnp.array([[1.9, 0.0], [3.9, 0.0], [9.0, 9.0]])
# 1 m to the first and 2 m on to the second, with a look at each.
IN_ORDER = (5 + 1) + (10 + 1)
# 3 m to the second, a half turn and .2 m back to the first.
BACKWARDS = (15 + 1) + (math.pi + 1 + 1)
AGENT = TeamAgent(TeamConfig(), 0.5, -1.0, 2, 2, (8,), True)
NETWORK = AGENT.network
CLASSES = Belief(np.float32([[1.0, 0.0], [-1.0, 0.5]]), np.full((2, 2), 0.2, np.float32))
AT_ORIGIN = {
    "belief": Belief(np.zeros((3, 2), np.float32), np.ones((3, 2), np.float32)),
    "team": Team(
        positions=PLACES,
        present=np.ones(3, bool),
        poses=np.zeros((2, 3), np.float32),
        modality=np.arange(2),
        works=np.ones(2, bool),
        target=np.full(2, 3),
    ),
    "robot": np.int32(0),
}


def make_mdp(present=2, max_steps=300):
    mapped = classes_mdp(partly_seen_starts=False)
    given = {"num_pois": (present, present), "alone": 1.0, "partly_seen": 0.0, "travel": TRAVEL}
    places = Fixed(PLACES, jnp.zeros((2, 3)))
    return team_mdp_of(mapped, places, max_steps=max_steps, **given)


def trials_of(present=2, max_steps=300, walk=0, bonus=0.0):
    """Trials in 64 states; all look once at each PoI in the order of their numbers."""
    # Defaults would be constants of a program.
    return _trials(present, max_steps, walk, bonus)


@pytree
class InOrder:
    """All look once at each PoI, in the order of their numbers; it reads what has been seen."""

    bonus: jax.Array

    def read(self, belief, is_seen):
        return jnp.append(belief.mean, is_seen)

    def values(self, read, state):
        # What has been read is what is on the map now.
        belief, is_seen = state.map.belief, jnp.any(state.map.seen, axis=-1)
        is_right = jnp.array_equal(read, jax.vmap(self.read)(belief, is_seen))
        own = state.map.seen[:, state.team.modality[state.agent]]
        of_pois = jnp.where(own | ~state.team.present, -1.0, 3.0 - jnp.arange(3))
        return jnp.append(of_pois + self.bonus, 0.0) + jnp.where(is_right, 0.0, jnp.nan)


@functools.partial(jax.jit, static_argnums=0)
def _trials(present, max_steps, walk, bonus):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tours, "_TRIES", 2)
        patch.setattr(tours, "_WALK", walk)
        mdp = make_mdp(present, max_steps)
        return tours.try_choices(jax.random.key(0), mdp, InOrder(bonus), 64)


def fitting(trials, **config):
    return tours.Fitting(ToursConfig(**config), trials, NETWORK, 2)


def own_seconds(trials):
    return team_mdp.own_seconds(trials.observation.reshape(NETWORK.features, 3, 64), 2)


def test_seconds_until_all_are_done_as_worked_by_hand():
    found = trials_of()
    np.testing.assert_array_equal(found.is_tried, np.repeat([[True], [True], [False]], 64, 1))
    # The other robot goes in order in either case.
    expected = [IN_ORDER, (BACKWARDS + IN_ORDER) / 2]
    np.testing.assert_allclose(found.seconds[:2], np.repeat(expected, 64).reshape(2, 64), rtol=1e-5)
    np.testing.assert_allclose(own_seconds(found)[:2, 0], [6.0, 16.0], rtol=1e-5)


def test_as_many_choices_are_tried_as_asked_and_near_ones_more_often():
    found = trials_of(present=3)
    np.testing.assert_array_equal(found.is_tried.sum(axis=0), 2)
    # The third is 45 s farther than the second, and so comes e^9 times as rarely.
    np.testing.assert_array_equal(found.is_tried.sum(axis=1), [64, 64, 0])


def test_trials_start_some_choices_on():
    found = trials_of(walk=6)
    # After the first look at a PoI a robot has no choice any more, and none is recorded.
    assert 5 < found.is_tried.any(axis=0).sum() < 60
    assert set(found.is_tried.sum(axis=0).tolist()) == {0, 2}
    assert len(np.unique(np.round(own_seconds(found)[0], 3))) > 1
    # Seconds count from the choice on, of which no way is longer than the whole.
    assert found.seconds.max() <= 1.0001 * max(IN_ORDER, (BACKWARDS + IN_ORDER) / 2)


def test_a_team_that_never_ends_stops_at_the_limit():
    ends = [trials_of(max_steps=limit, bonus=10.0).seconds for limit in (7, 14)]
    # Looks follow one another: 6 s for the first way, at most 3 m and half a turn for each.
    assert (ends[0][:2] > 6).all()
    assert (ends[0][:2] < ends[1][:2]).all()
    assert (ends[1][:2] < 14 * (15 + math.pi + 1)).all()


def test_the_loss_is_of_differences_within_a_state():
    size = NETWORK.features * 3
    params = jax.tree.map(jnp.zeros_like, networks.init(jax.random.key(0), NETWORK, size))
    # All predictions are the ways themselves.
    known = np.zeros((NETWORK.features, 3, 2), np.float32)
    known[4] = [[0.6, 0.1], [1.6, 0.2], [0, 0]]
    known[-3, :2] = 1.0
    tried = jnp.array([[True, True], [True, True], [False, False]])
    seconds = jnp.array([[26.0, 31.0], [36.0, 32.0], [5.0, 9.0]])
    trials = Trials(jnp.asarray(known.reshape(-1, 2)), tried, seconds)
    both = jnp.arange(2)
    loss = jax.jit(lambda trials: fitting(trials).loss(params, both, jnp.int32(0)))
    # 6 and 16 s, and 1 and 2 s: each 20 and 30 s too little, and that is no error.
    assert loss(trials) < 1e-6
    # 6 s off between the two: 3 s each from their mean, of 3 s.
    later = replace(trials, seconds=trials.seconds.at[1, 0].add(6.0))
    expected = 2 * (math.sqrt(2) - 1) / 4
    np.testing.assert_allclose(loss(later), expected, rtol=1e-5)


def test_columns_are_written_and_only_those_with_a_trial_drawn():
    room = tours.no_trials(2, 3, 5)
    one = Trials(jnp.ones((6, 2)), jnp.ones((3, 2), bool), jnp.ones((3, 2)))
    found = tours.write(room, one, jnp.int32(3))
    np.testing.assert_array_equal(found.seconds.sum(axis=0), [0, 0, 0, 3, 3])
    np.testing.assert_array_equal(found.observation.sum(axis=0), [0, 0, 0, 6, 6])
    drawn = fitting(found, states=5).draw(jax.random.key(0), 8)
    assert drawn.shape == (8, 5)
    assert set(np.asarray(drawn).ravel().tolist()) == {3, 4}


def test_training_finds_the_shorter_tour():
    trials = trials_of()
    problem = fitting(trials, steps=400)
    params = networks.init(jax.random.key(1), NETWORK, NETWORK.features * 3)
    state = supervised.start(params, problem.config)
    fit = jax.jit(lambda state: supervised.fit(jax.random.key(2), state, problem, 100))
    state, losses = fit(state)
    assert losses[-1] < 1e-3 < losses[0]
    learned = jax.jit(lambda x: tours.seconds(NETWORK, state.params, x, 2))(trials.observation)
    expected = (BACKWARDS - IN_ORDER) / 2
    np.testing.assert_allclose(learned[1] - learned[0], expected, atol=0.2)


@pytest.mark.parametrize(
    ("after", "cost", "order"),
    [
        ([1.0, 1.0, 1.0], 0.0, [2, 0, 1, 3]),  # the soonest first, NOP last
        ([1.0, -1.0, 1.0], 0.0, [2, 0, 3, 1]),  # what is not worth its way below NOP
        ([-1.0, -1.0, -1.0], 0.0, [3]),
        ([1.0, 1.0, 7.0], 0.1, [2, 0, 3, 1]),  # ways of 6, 16 and 61 s at .1 a second
    ],
)
def test_looks_that_pay_come_in_the_order_of_their_tours(monkeypatch, after, cost, order):
    values = decided(monkeypatch, after, cost)
    assert np.argsort(-values)[: len(order)].tolist() == order


@pytest.mark.parametrize(
    ("unknown", "chosen"), [([True, True, True], 2), ([True, False, False], 0)]
)
def test_a_robot_stays_until_the_look_of_a_nearer_one_was_enough(monkeypatch, unknown, chosen):
    """The network leaves the first PoI to another robot, as soon as one heads for a PoI."""

    def q(self, params, observed):
        sigma = sigmas(observed, self.network.features)
        is_headed_for = observed.reshape(self.network.features, 3, *observed.shape[1:])[6] > 0
        of_first = jnp.where(jnp.any(is_headed_for), -5.0, 5.0)
        of_each = jnp.stack([of_first, *jnp.full(2, 5.0)]).reshape(3, *[1] * (sigma.ndim - 1))
        values = jnp.where(sigma > 0.3, of_each, 0.0)
        return jnp.concatenate([values, jnp.zeros_like(values[:1])])

    replace_q(monkeypatch, q)
    monkeypatch.setattr(tours, "seconds", lambda *known: jnp.array([20.0, 30.0, 10.0]))
    std = np.where(np.array(unknown)[:, None], 1.0, 0.2).astype(np.float32)
    team = replace(AT_ORIGIN["team"], target=np.array([3, 0]))
    belief = Belief(CLASSES.mean[[0, 0, 0]], np.broadcast_to(std, (3, 2)))
    given = {**AT_ORIGIN, "belief": belief, "team": team}
    values = jax.jit(lambda: AGENT.decide({}, ({},), classes=CLASSES, **given))()
    assert np.argmax(values) == chosen
    # What is known, or left to the other while there is more to do, comes below NOP.
    assert [bool(x) for x in values[:3] > values[3]] == [chosen == 0, *unknown[1:]]


def test_nan_of_the_q_network_stays_visible(monkeypatch):
    values = decided(monkeypatch, [jnp.nan, 1.0, 1.0], 0.0)
    np.testing.assert_array_equal(np.isnan(values), [True, False, False, False])


def sigmas(observed, features):
    """Of the three PoIs, along the first latent dimension."""
    return observed.reshape(features, 3, *observed.shape[1:])[2]


def replace_q(monkeypatch, q):
    """Replaces the Q-network of three PoIs by a function of what a robot knows."""

    def of_all(self, params, observed, others=None):
        if others is None:
            return q(self, params, observed)
        x, rest = (given.reshape(self.network.features, 3) for given in (observed, others))
        mixed = [rest.at[:, i].set(x[:, i]).reshape(-1) for i in range(3)]
        return jnp.stack([*(q(self, params, x)[i] for i, x in enumerate(mixed)), 0.0])

    monkeypatch.setattr(TeamAgent, "q", of_all)


def decided(monkeypatch, after, cost):
    """Values in a mission, where the networks say what follows looks, and 20, 30 and 10 s."""

    def q(self, params, observed):
        sigma = sigmas(observed, self.network.features)
        of_each = jnp.array(after).reshape(3, *[1] * (sigma.ndim - 1))
        # At a PoI that is known, with a sigma of .2, the network takes a useless look for -.7.
        values = jnp.where(sigma > 0.3, of_each - self.useless - 0.7, -0.7)
        return jnp.concatenate([values, jnp.zeros_like(values[:1])])

    replace_q(monkeypatch, q)
    monkeypatch.setattr(tours, "seconds", lambda *known: jnp.array([20.0, 30.0, 10.0]))
    agent = replace(AGENT, config=TeamConfig(second_cost=cost))
    return jax.jit(lambda: agent.decide({}, ({},), classes=CLASSES, **AT_ORIGIN))()


def test_what_is_left_to_learn_elsewhere_makes_no_look_worth_its_way(monkeypatch):
    """A network that adds up sigmas: of the PoI less .5, and half of the others'."""

    def q(self, params, observed):
        sigma = sigmas(observed, self.network.features)
        elsewhere = 0.5 * (jnp.sum(sigma, axis=0, keepdims=True) - sigma)
        return jnp.concatenate([sigma - 0.5 + elsewhere, jnp.zeros_like(sigma[:1])])

    replace_q(monkeypatch, q)
    agent = replace(AGENT, discount=1.0)
    belief = Belief(jnp.zeros((3, 2)), jnp.array([[0.1, 1.0], [1.5, 1.0], [0.1, 1.0]]))
    given = {**AT_ORIGIN, "belief": belief}
    # Were all three known, with sigmas of .2, it would say .2 - .5 + .2 of a look that earns -1.
    worth = jax.jit(lambda: agent.worth({}, CLASSES, **given))()
    np.testing.assert_allclose(worth, [0.1 - 0.2 - 1, 1.5 - 0.2 - 1, 0.1 - 0.2 - 1], rtol=1e-5)


def test_what_a_look_is_worth_does_not_depend_on_who_else_is_near(monkeypatch):
    def q(self, params, observed):
        features = self.network.features
        surroundings = observed.reshape(features, 3, *observed.shape[1:])[5:]
        values = sigmas(observed, features) * (1 + jnp.sum(surroundings, axis=0))
        return jnp.concatenate([values, jnp.zeros_like(values[:1])])

    replace_q(monkeypatch, q)
    team = AT_ORIGIN["team"]
    poses, heads = np.array([[0, 0, 0], [*PLACES[0], 0]], np.float32), np.array([3, 0])
    near = replace(team, poses=poses, target=heads)
    of_team = jax.jit(lambda team: AGENT.worth({}, CLASSES, **{**AT_ORIGIN, "team": team}))
    worth, same = of_team(team), of_team(near)
    np.testing.assert_array_equal(worth, same)
    # A PoI that the robot has given up is never worth a look.
    gone = replace(team, present=np.array([True, False, True]))
    left = of_team(gone)
    assert left[1] <= 0


def of_sigmas(monkeypatch, after):
    """Q-values of PoIs with a sigma of 1; 0 of those that are known."""

    def q(self, params, observed):
        sigma = sigmas(observed, self.network.features)
        of_each = jnp.array(after).reshape(3, *[1] * (sigma.ndim - 1))
        values = jnp.where(sigma > 0.3, of_each, 0.0)
        return jnp.concatenate([values, jnp.zeros_like(values[:1])])

    replace_q(monkeypatch, q)


def test_without_tours_the_values_are_those_of_setting_out(monkeypatch):
    of_sigmas(monkeypatch, [8.0, 3.0, 16.0])
    values = jax.jit(lambda: AGENT.decide({}, (), classes=CLASSES, **AT_ORIGIN))()
    # .94 m, 2.94 m and, an eighth of a turn away, 11.77 m at .2 m/s, and looks of .7 s. Each second
    # halves a value.
    seconds = np.array([5.4, 15.4, math.pi / 4 / 1.2 + (9 * math.sqrt(2) - 0.96) / 0.2 + 0.7])
    expected = [*np.array([8.0, 3.0, 16.0]) * 0.5**seconds, 0.0]
    np.testing.assert_allclose(values, expected, rtol=1e-4)


def test_without_tours_a_look_no_better_than_one_at_a_known_poi_comes_last(monkeypatch):
    # A useless look earns -1, the network says 0: .9 is not enough.
    of_sigmas(monkeypatch, [8.0, 0.9, jnp.nan])
    values = jax.jit(lambda: AGENT.decide({}, (), classes=CLASSES, **AT_ORIGIN))()
    assert values[0] > values[3] == 0 > values[1]
    assert jnp.isnan(values[2])


def test_no_two_networks_start_alike():
    config = PRESETS["team"]

    @jax.jit
    def last_leaves(key):
        models = init(key, config)
        return [jax.tree.leaves(x)[-1] for x in (*models.q_networks, *models.tours)]

    firsts = last_leaves(jax.random.key(0))
    for i, one in enumerate(firsts):
        assert all(not np.array_equal(one, other) for other in firsts[i + 1 :])
