"""Trials of choices, with times worked by hand, and what is learned from them."""

import functools
import math
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from toys import Fixed, classes_mdp, team_mdp_of

from jaxsense.config.learning import ToursConfig
from jaxsense.core import networks, supervised
from jaxsense.core.types import Belief, pytree
from jaxsense.dqn import hybrid, tours
from jaxsense.dqn.agent import Agent
from jaxsense.dqn.team import Known, Team, Travel
from jaxsense.dqn.tours import Trials

TRAVEL = Travel(speed=0.2, turn_rate=1.0, view_distance=0.9, look_seconds=1.0)
# In a row, 1.9 and 3.9 m from two robots at the origin; the third is not present.
PLACES = jnp.array([[1.9, 0.0], [3.9, 0.0], [9.0, 9.0]])
# 1 m to the first and 2 m on to the second, with a look at each.
IN_ORDER = (5 + 1) + (10 + 1)
# 3 m to the second, a half turn and .2 m back to the first.
BACKWARDS = (15 + 1) + (math.pi + 1 + 1)
AGENT = Agent(0.5, 0.0, -1.0, Travel(0.96), 3, 2, 2, (8,))
NETWORK = AGENT.network
CLASSES = Belief(np.float32([[1.0, 0.0], [-1.0, 0.5]]), np.full((2, 2), 0.2, np.float32))
AT_ORIGIN = Known(
    belief=Belief(np.zeros((3, 2), np.float32), np.ones((3, 2), np.float32)),
    looks=np.zeros((3, 2), np.int32),
    log_posterior=np.zeros((3, 2), np.float32),
    team=Team(
        positions=PLACES,
        present=np.ones(3, bool),
        poses=np.zeros((2, 3), np.float32),
        modality=np.arange(2),
        works=np.ones(2, bool),
        target=np.full(2, 3),
    ),
    times=np.ones((2, 3), np.float32),
    robot=np.int32(0),
)


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
        belief, is_seen = state.belief, jnp.any(state.seen, axis=-1)
        is_right = jnp.array_equal(read, jax.vmap(self.read)(belief, is_seen))
        own = state.seen[:, state.team.modality[state.agent]]
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
    return tours.Fitting(ToursConfig(**config), trials, AGENT)


def own_seconds(trials):
    return AGENT.seconds(trials.observation)


def test_seconds_until_all_are_done_as_worked_by_hand():
    found = trials_of()
    np.testing.assert_array_equal(found.is_tried, np.repeat([[True], [True], [False]], 64, 1))
    # The other robot goes in order in either case.
    expected = [IN_ORDER, (BACKWARDS + IN_ORDER) / 2]
    np.testing.assert_allclose(found.seconds[:2], np.repeat(expected, 64).reshape(2, 64), rtol=1e-5)
    np.testing.assert_allclose(own_seconds(found)[:2, 0], [6.0, 16.0], rtol=1e-5)


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


def test_training_finds_the_shorter_tour():
    trials = trials_of()
    problem = fitting(trials, steps=400)
    params = networks.init(jax.random.key(1), NETWORK, NETWORK.features * 3)
    state = supervised.start(params, problem.config)
    fit = jax.jit(lambda state: supervised.fit(jax.random.key(2), state, problem, 100))
    state, losses = fit(state)
    assert losses[-1] < 1e-3 < losses[0]
    learned = jax.jit(lambda x: tours.seconds(AGENT, state.params, x))(trials.observation)
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

    monkeypatch.setattr(Agent, "q", of_all)


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
    agent = replace(AGENT, second_cost=cost)
    return jax.jit(lambda: hybrid.decide(agent, {}, ({},), CLASSES, AT_ORIGIN))()


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
    values = jax.jit(lambda: hybrid.decide(AGENT, {}, (), CLASSES, AT_ORIGIN))()
    # .94 m, 2.94 m and, an eighth of a turn away, 11.77 m at .2 m/s, and looks of .7 s. Each second
    # halves a value.
    seconds = np.array([5.4, 15.4, math.pi / 4 / 1.2 + (9 * math.sqrt(2) - 0.96) / 0.2 + 0.7])
    expected = [*np.array([8.0, 3.0, 16.0]) * 0.5**seconds, 0.0]
    np.testing.assert_allclose(values, expected, rtol=1e-4)
