"""The optimal policy against dynamic programming over all that a robot can know."""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from toys import Toy, make_mdp, policy

from jaxsense.core.types import Belief, pytree
from jaxsense.dqn import episodes, optimum

# The camera tells class 0 from the others, the LiDAR class 2.
LABELS = ((1, 0, 0), (0, 0, 1))
# Information about a PoI, by the classes left open: some looks pay, some lose, and of some only one
# who knows the class could say.
INFORMATION = {(0, 1, 2): 0.2, (0,): 1.0, (1, 2): 0.3, (0, 1): 0.4, (2,): 1.2, (1,): 0.1}
TABLE = np.zeros(8, np.float32)
for _classes, _information in INFORMATION.items():
    TABLE[sum(1 << c for c in _classes)] = _information
MIN_INCREASE = 0.15
KEY = jax.random.key(0)


@pytree
class OfOpenClasses:
    """A gain in the table above `MIN_INCREASE`, or -1."""

    @property
    def is_of_labels(self):
        return False

    def information(self, belief, probabilities):
        return jnp.array(TABLE)[jnp.sum((probabilities > 0.01) << jnp.arange(3))]

    def of_gain(self, gain):
        return jnp.where(gain > MIN_INCREASE, gain, -1.0)


@pytree
class Sharp:
    """A look without noise: logarithms of how likely each class makes what it shows."""

    num_modalities = 2

    def scene(self, key, classes):
        return classes

    def observe(self, key, scene, poi, modality):
        labels = jnp.array(LABELS[modality])
        return jnp.where(labels == labels[scene[poi]], 0.0, -200.0), scene


@pytree
class Exact(Toy):
    """A belief's mean holds the logarithms of the classes' probabilities."""

    def update(self, belief, seen, features, modality):
        return Belief(belief.mean + features, belief.std)

    def class_probabilities(self, belief):
        return jax.nn.softmax(belief.mean)


@pytree
class Told:
    """Exact Bayes."""

    def log_likelihoods(self, features, modality):
        return features


def known_mdp(num_pois):
    fusion = Exact(Belief(jnp.zeros(3), jnp.ones(3)), 3)
    looked = make_mdp(Sharp(), fusion, num_pois, max_steps=2 * num_pois)
    return looked.replace(reward=OfOpenClasses())


def values_of(mdp):
    """Values of looks by dynamic programming, of each sensor."""

    def of_modality(m):
        likelihoods = [mdp.looks.observe(KEY, jnp.arange(3), c, m)[0] for c in range(3)]
        return optimum.value_iteration(
            jnp.stack(likelihoods)[:, None],
            mdp.reward,
            lambda p: Belief(jnp.log(p), jnp.ones(3)),
            mdp.fusion.prior,
            mdp.config,
            horizon=3,
        )

    return tuple(map(of_modality, (0, 1)))


def left_open(classes, poi_class, modality):
    """Those that a look at a PoI of this class leaves open."""
    labels = LABELS[modality]
    return tuple(c for c in classes if labels[c] == labels[poi_class])


@functools.cache
def value(pois, modality, steps):
    """Most that can be expected, by the classes left open of each PoI."""
    best = 0.0  # of NOP
    if steps == 0:
        return best
    for n, classes in enumerate(pois):
        total = 0.0
        for poi_class in classes:
            after = left_open(classes, poi_class, modality)
            gain = INFORMATION[after] - INFORMATION[classes]
            rest = tuple(sorted((*pois[:n], after, *pois[n + 1 :])))
            total += gain if gain > MIN_INCREASE else -1.0
            total += value(rest, modality, steps - 1)
        best = max(best, total / len(classes))
    return best


def known_of_start(classes, bits):
    """For each PoI the classes left open, and who has looked."""
    known = []
    for n, poi_class in enumerate(classes):
        looks, remaining = bits[2 * n : 2 * n + 2], (0, 1, 2)
        for m in range(2):
            remaining = left_open(remaining, poi_class, m) if looks[m] else remaining
        known.append((remaining, looks))
    return tuple(known)


@pytest.mark.parametrize("num_pois", [2, pytest.param(3, marks=pytest.mark.slow)])
def test_no_policy_expects_more_than_the_optimal_one(num_pois):
    states = [
        (classes, seen)
        for classes in itertools.product(range(3), repeat=num_pois)
        for seen in itertools.product((False, True), repeat=2 * num_pois)
    ]
    classes = jnp.array([c for c, _ in states])
    seen = jnp.array([s for _, s in states]).reshape(-1, num_pois, 2)

    @jax.jit
    def play(mdp, modality):
        models = {"look_values": values_of(mdp), "fusion": mdp.fusion}
        compared = [policy(name, **models) for name in ("optimal", "bayes", "naive", "random")]

        def totals(key, classes, seen):
            start = episodes.reset(KEY, mdp, Told(), classes, seen)
            return [
                episodes.run_episode(key, mdp, Told(), act, start, modality)[0] for act in compared
            ]

        return jax.vmap(totals)(jax.random.split(KEY, len(states)), classes, seen)

    for modality in (0, 1):
        optimal, short, naive, uniform = np.asarray(play(known_mdp(num_pois), jnp.int32(modality)))
        # What a robot knows is the same in several states: it can only do well in their mean.
        groups = {}
        for row, state in enumerate(states):
            groups.setdefault(known_of_start(*state), []).append(row)
        assert len(groups) == 8**num_pois
        for known, rows in groups.items():
            best = value(tuple(sorted(open_ for open_, _ in known)), modality, num_pois + 1)
            np.testing.assert_allclose(optimal[rows].mean(), best, atol=1e-4)
            for other in (short, naive):
                assert other[rows].mean() <= best + 1e-4
        assert naive.mean() < optimal.mean() - 0.1
        # Its draws are of each state its own: four standard errors of their mean.
        assert uniform.mean() <= optimal.mean() + 4 * uniform.std() / np.sqrt(len(states))
