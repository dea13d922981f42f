"""The values of looks by dynamic programming, against enumeration and against play."""

import functools
import math
from collections.abc import Callable
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

from jaxsense.config import MdpConfig
from jaxsense.core.types import Belief, pytree
from jaxsense.dqn import optimum, rewards
from jaxsense.dqn.rewards import Reward

HORIZON = 3
interpolate = jax.jit(jax.vmap(optimum.interpolate, in_axes=(None, 0)))
PRIOR = Belief(jnp.zeros(3), jnp.full(3, 2.0))


@pytree
class Of:
    """The reward of settings, for another information of class probabilities.

    The prior, whose standard deviation is 2, may have information of its own.
    """

    information_of: Callable = struct.field(pytree_node=False)
    rule: Reward
    of_prior: jax.Array | None = None

    @property
    def is_of_labels(self):
        return False

    def information(self, belief, probabilities):
        known = self.information_of(probabilities)
        if self.of_prior is None:
            return known
        return jnp.where(belief.std[0] == 2, self.of_prior, known)

    def of_gain(self, gain):
        return self.rule.of_gain(gain)


def certain(probabilities):
    return Belief(jnp.log(probabilities), jnp.ones(len(probabilities)))


@functools.partial(jax.jit, static_argnames="horizon")
def solve(likelihoods, reward, config, horizon):
    return optimum.value_iteration(likelihoods, reward, certain, PRIOR, config, horizon)


def entropy(weights):
    return -sum(w * math.log(w) for w in weights if w > 0)


# Information of class probabilities, for enumeration and for the table, and the settings.
REWARDS = {
    "nats": (
        lambda weights: -entropy(weights),
        lambda weights: -rewards.entropy(weights),
        MdpConfig(reward="nats", look_cost=0.02),
    ),
    "paper": (
        lambda weights: 2 * sum(w * w for w in weights),
        lambda weights: 2 * jnp.sum(weights**2),
        MdpConfig(reward="paper", min_increase=0.12),
    ),
}
# For each class two looks that are equally likely, and how likely every class makes each.
ROUND, EDGY = (0.8, 0.2), (0.2, 0.8)
RED, GREEN = (0.8, 0.5, 0.1), (0.2, 0.5, 0.9)
LOOKS = {2: ((ROUND, ROUND), (EDGY, ROUND)), 3: ((RED, RED), (RED, GREEN), (GREEN, GREEN))}
# Points of the lattices, of 512 and of 126 steps.
STARTS = {
    2: ((1 / 2, 1 / 2), (3 / 4, 1 / 4), (7 / 8, 1 / 8), (1 / 16, 15 / 16), (1, 0)),
    3: ((1 / 3, 1 / 3, 1 / 3), (1 / 2, 1 / 3, 1 / 6), (1 / 6, 1 / 6, 2 / 3), (1 / 3, 2 / 3, 0)),
}


def enumerated(name, weights, horizon):
    """Expected reward of a look and of all that pay after it, over all that looks may show."""
    (information, _, config), looks = REWARDS[name], LOOKS[len(weights)]
    expected = 0.0
    for chance, of_class in zip(weights, looks, strict=True):
        for likelihoods in of_class:
            after = [w * x for w, x in zip(weights, likelihoods, strict=True)]
            after = [w / sum(after) for w in after]
            gain = information(after) - information(weights)
            if name == "nats":
                reward = gain - config.look_cost
            else:
                # No gain that comes up is so near to the threshold that a point beside it is
                # rewarded otherwise.
                assert abs(gain - config.min_increase) > 0.015
                reward = gain if gain > config.min_increase else -1.0
            later = max(enumerated(name, after, horizon - 1), 0.0) if horizon > 1 else 0.0
            expected += chance / len(of_class) * (reward + later)
    return expected


@pytest.mark.parametrize("number", [2, 3])
@pytest.mark.parametrize("name", REWARDS)
def test_values_are_those_of_all_histories(name, number):
    _, information, config = REWARDS[name]
    reward = Of(information, rewards.make(config))
    likelihoods = jnp.log(jnp.array(LOOKS[number]))
    starts = jnp.array(STARTS[number], jnp.float32)
    by_horizon = []
    for horizon in (1, 2, HORIZON):
        found = solve(likelihoods, reward, config, horizon)
        gain = [enumerated(name, weights, 1) for weights in STARTS[number]]
        total = [enumerated(name, weights, horizon) for weights in STARTS[number]]
        np.testing.assert_allclose(interpolate(found.one_step, starts), gain, atol=1e-5)
        # A step of the lattice apart, a slope that changes by 1 where looks begin to pay is read
        # wrongly by a quarter of the step.
        error = 0.25 / optimum.steps_of_lattice(number) if horizon > 1 else 1e-5
        np.testing.assert_allclose(interpolate(found.q, starts), total, atol=error)
        # The first start is that of equal probabilities.
        first = [found.one_step_unseen, found.q_unseen]
        np.testing.assert_allclose(first, [gain[0], total[0]], atol=error)
        by_horizon.append(total[0])
    # Later looks pay.
    assert by_horizon[0] + 0.005 < by_horizon[2]


# For each world the label of each class, and how likely a look at a label shows each, in steps of
# a fifth and of a twentieth. Of four shapes, two look alike from some sides.
GRIDS = {
    "2x2": ((0, 0, 1, 1), ((0.8, 0.2), (0.2, 0.8)), 5),
    "4x4": (
        tuple(c % 4 for c in range(16)),
        (
            (0.80, 0.10, 0.05, 0.05),
            (0.10, 0.55, 0.30, 0.05),
            (0.05, 0.30, 0.50, 0.15),
            (0.05, 0.05, 0.15, 0.75),
        ),
        20,
    ),
}
COST = 0.05


def starts_of(world):
    """Posteriors over the classes: all are equally likely, then some are not."""
    number = len(GRIDS[world][0])
    random = np.random.default_rng(0).dirichlet(np.full(number, 0.4), 3)
    return [[1 / number] * number, *random.tolist()]


def shown_of(world, weights):
    """Probability of each thing that a look may show, and the posterior after it."""
    label_of_class, table, _ = GRIDS[world]
    for shown in range(len(table)):
        joint = [w * table[label_of_class[c]][shown] for c, w in enumerate(weights)]
        yield sum(joint), [w / sum(joint) for w in joint]


def over_classes(world, weights, horizon, is_greedy=False):
    """Expected nats of a look and of all after it that pay: in total, or each alone if greedy."""
    expected = 0.0
    for chance, after in shown_of(world, weights):
        later = 0.0
        if horizon > 1:
            later = over_classes(world, after, horizon - 1, is_greedy)
            pays = over_classes(world, after, 1) if is_greedy else later
            later = later if pays > 0 else 0.0
        expected += chance * (entropy(weights) - entropy(after) - COST + later)
    return expected


def values_on_labels(world, horizon):
    """The tables of a sensor with labels."""
    label_of_class, table, parts = GRIDS[world]
    config = MdpConfig(reward="nats", look_cost=COST)
    looks = jnp.log(jnp.array(table)).T
    counts = np.round(parts * np.array(table)).astype(int)
    likelihoods = jnp.stack([looks[np.repeat(np.arange(len(table)), row)] for row in counts])
    found = solve(likelihoods, rewards.make(config), config, horizon)
    return replace(found, labels=jnp.eye(len(table))[jnp.array(label_of_class)])


@pytest.mark.parametrize("world", GRIDS)
def test_values_on_labels_are_those_of_all_histories_of_classes(world):
    horizon = 4
    found = values_on_labels(world, horizon)
    of_next, of_all = (jax.jit(jax.vmap(f, (0, None))) for f in (found.of_next, found.of_all))
    starts = jnp.array(starts_of(world))
    alone = [over_classes(world, weights, 1) for weights in starts_of(world)]
    total = [over_classes(world, weights, horizon) for weights in starts_of(world)]
    # Of four labels the lattice has 34 steps.
    error = {"2x2": 1e-3, "4x4": 1e-2}[world]
    np.testing.assert_allclose(of_next(starts, True), alone, atol=error)
    np.testing.assert_allclose(of_all(starts, True), total, atol=error)
    assert total[0] > alone[0] + 0.05


@pytest.mark.parametrize("horizon", [1, 8])
def test_values_of_looks_have_gradients_in_the_likelihoods(horizon):
    # The lattice has corners, where the entropy has an infinite slope.
    belief = Belief(jnp.zeros(1), jnp.ones(1))

    @jax.jit
    def value(accuracy):
        right, wrong = jnp.log(accuracy), jnp.log(1 - accuracy)
        looks = jnp.array([[[1, 0], [1, 0], [0, 1]], [[0, 1], [0, 1], [1, 0]]])
        looks = jnp.where(looks, right, wrong)
        found = optimum.value_iteration(
            looks, rewards.Nats(0.05), lambda p: belief, belief, MdpConfig(), horizon, 64
        )
        return found.of_all(jnp.array([0.3, 0.7]), jnp.bool_(True))

    gradient = float(jax.jit(jax.grad(value))(0.8))
    measured = float(value(0.801) - value(0.799)) / 0.002
    assert gradient == pytest.approx(measured, rel=0.02)
    assert gradient > 0.5


def test_the_entropy_has_a_finite_gradient_everywhere():
    found = jax.grad(rewards.entropy)(jnp.array([0.5, 0.5, 0.0]))
    # -(log p + 1), and 0 for a probability of 0.
    np.testing.assert_allclose(found, [np.log(2) - 1, np.log(2) - 1, 0], rtol=1e-6)
    # (ln 2) / 2 + 2 (ln 4) / 4; a class without weight counts nothing.
    weights = jnp.array([[0.5, 0.25, 0.25], [0.0, 0.5, 0.5], [0.0, 1.0, 0.0]])
    expected = [1.5 * np.log(2), np.log(2), 0.0]
    np.testing.assert_allclose(rewards.entropy(weights), expected, atol=1e-6)
