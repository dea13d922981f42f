"""The optimal policy against dynamic programming over all that a robot can know."""

import functools
import itertools
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from toys import classes_mdp

from jaxsense.core.types import Belief
from jaxsense.dqn import belief_mdp, episodes, policies

# The camera tells class 0 from the others, the LiDAR class 2.
LABELS = ((1, 0, 0), (0, 0, 1))
# Information of a PoI of each class, after nothing, the camera, the LiDAR and both: some looks pay,
# some lose, and of some only one who knows the class could say.
INFORMATION = np.array([[0.2, 0.2, 0.2], [1.0, 0.5, 0.1], [0.9, 0.4, 1.2], [1.1, 0.3, 1.3]])
MIN_INCREASE = 0.15
KEY = jax.random.key(0)


def known_mdp(num_pois):
    """A look without noise: information is that of the table, by who has looked and the class."""

    def write(belief, seen, features, modality):
        code = jnp.sum(seen.at[modality].set(True) << jnp.arange(2))
        information = jnp.array(INFORMATION, jnp.float32)[code, features[0].astype(int)]
        return Belief(features, jnp.array([1.0, 0.0]) / information)

    return replace(
        classes_mdp(num_pois, min_increase=MIN_INCREASE, max_steps=2 * num_pois),
        unseen=Belief(jnp.zeros(2), jnp.array([5.0, 0.0])),
        write=write,
    )


def reward_of(seen, poi_class, modality):
    """Of one look, after those of the modalities in `seen`."""

    def information(modalities):
        return INFORMATION[sum(1 << m for m in modalities), poi_class]

    gain = information({*seen, modality}) - information(seen)
    return gain if gain > MIN_INCREASE else -1.0


def open_classes(seen, poi_class):
    """Those that the modalities in `seen` detect as they do this one."""
    return frozenset(c for c in range(3) if all(LABELS[m][c] == LABELS[m][poi_class] for m in seen))


@functools.cache
def value(pois, modality, steps):
    """Most that can be expected: of each PoI is known who has looked, and the classes left open."""
    best = 0.0  # of NOP
    if steps == 0:
        return best
    for n, (seen, classes) in enumerate(pois):
        total = 0.0
        for poi_class in classes:
            after = frozenset({*seen, modality})
            known = after, open_classes(after, poi_class)
            rest = tuple(sorted((*pois[:n], known, *pois[n + 1 :]), key=repr))
            total += reward_of(seen, poi_class, modality) + value(rest, modality, steps - 1)
        best = max(best, total / len(classes))
    return best


@pytest.mark.parametrize("num_pois", [2, 3])
def test_no_policy_expects_more_than_the_optimal_one(num_pois):
    mdp = known_mdp(num_pois)
    states = [
        (classes, seen)
        for classes in itertools.product(range(3), repeat=num_pois)
        for seen in itertools.product((False, True), repeat=2 * num_pois)
    ]
    classes = jnp.array([c for c, _ in states])
    seen = jnp.array([s for _, s in states]).reshape(-1, num_pois, 2)

    @jax.jit
    def play(modality):
        rewards = policies.expected_rewards(KEY, mdp, modality, num_draws=2)
        compared = (
            policies.optimal(mdp, rewards, jnp.array(LABELS)),
            policies.naive(mdp, modality),
            policies.random(mdp),
        )

        def totals(key, classes, seen):
            start = belief_mdp.reset(KEY, mdp, classes, seen)
            return [episodes.run_episode(key, mdp, p, start, modality)[0] for p in compared]

        return jax.vmap(totals)(jax.random.split(KEY, len(states)), classes, seen)

    for modality in (0, 1):
        optimal, naive, uniform = np.asarray(play(jnp.int32(modality)))
        # What a robot knows is the same in several states: it can only do well in their mean.
        groups = {}
        for row, (of_pois, bits) in enumerate(states):
            looks = [frozenset(m for m in (0, 1) if bits[2 * n + m]) for n in range(num_pois)]
            known = zip(looks, map(open_classes, looks, of_pois), strict=True)
            groups.setdefault(tuple(known), []).append(row)
        assert len(groups) == 8**num_pois
        for pois, rows in groups.items():
            best = value(tuple(sorted(pois, key=repr)), modality, num_pois + 1)
            np.testing.assert_allclose(optimal[rows].mean(), best, atol=1e-4)
            assert naive[rows].mean() <= best + 1e-4
        assert naive.mean() < optimal.mean() - 0.1
        # Its draws are of each state its own: four standard errors of their mean.
        assert uniform.mean() <= optimal.mean() + 4 * uniform.std() / np.sqrt(len(states))
