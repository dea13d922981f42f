"""Whole episodes with known totals, and the count of the map's states."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from toys import Ignorant, classes_mdp, noisy_mdp, policy

from jaxsense.core.types import pytree
from jaxsense.dqn import episodes

MDP, NOP, KEY = classes_mdp(), 3, jax.random.key(0)


def scripted(*actions):
    """A policy that takes the given actions one after the other."""
    return lambda seen: (
        lambda key, known: jnp.array(actions)[jnp.sum(known.looks) - int(np.sum(seen))]
    )


def forgetting(act):
    """The policy as one with a memory, in which it writes nothing."""
    return lambda key, known, memory: (act(key, known), memory)


def play(mdp, act, seen, modality=0):
    begun = episodes.reset(KEY, mdp, Ignorant(), jnp.array([0, 1, 2]), jnp.array(seen, bool))
    return episodes.run_episode(KEY, mdp.of(modality), Ignorant(), forgetting(act(seen)), begun)


def test_naive_play_has_the_total_worked_by_hand():
    # PoI 0 unseen: .2 - .158114; PoI 1 seen by the LiDAR: 1 - .2; PoI 2 seen by both: no look.
    total, first = play(MDP, lambda seen: policy("naive"), [[0, 0], [0, 1], [1, 1]])
    np.testing.assert_allclose(total, 0.041886 + 0.8, rtol=1e-4)
    np.testing.assert_allclose(first, 0.041886, rtol=1e-3)


def test_first_reward_is_that_of_the_first_action_alone():
    total, first = play(MDP, scripted(2, 1, 2, NOP), [[0, 0], [0, 1], [1, 1]])
    np.testing.assert_allclose(first, -1.0)
    np.testing.assert_allclose(total, -1.0 + 0.8 - 1.0, rtol=1e-5)
    total, first = play(MDP, scripted(NOP, 1), [[0, 0], [0, 1], [1, 1]])
    assert (total, first) == (0.0, 0.0)


def test_the_kth_look_at_a_poi_sees_the_same_in_any_order():
    mdp, seen = noisy_mdp(), np.zeros((3, 2))  # what a look adds depends on its key alone
    total, first = play(mdp, scripted(0, 1, 0, 2, NOP), seen)
    others = [play(mdp, scripted(*a, NOP), seen) for a in ((2, 0, 0, 1), (1, 2, 0, 0))]
    np.testing.assert_allclose([t for t, _ in others], total, rtol=1e-5)
    # Looks at different PoIs see different things, and so do two looks at one.
    firsts = [first, *(f for _, f in others)]
    assert len(np.unique(np.round(firsts, 4))) == 3
    twice, once = play(mdp, scripted(0, 0, NOP), seen)
    assert not np.isclose(twice, 2 * once)


@pytest.mark.parametrize(
    "sizes",
    # PoIs, classes, modalities: as many PoIs as classes, fewer, more; 4096 states.
    [(3, 3, 2), (2, 3, 2), (2, 5, 3), (4, 2, 1), (3, 1, 2), (6, 2, 1)],
)
def test_states_come_in_the_order_of_an_enumeration(sizes):
    num_pois, num_classes, num_modalities = sizes
    # The first look changes fastest.
    looks = [bits[::-1] for bits in itertools.product((0, 1), repeat=num_pois * num_modalities)]
    every = itertools.product(range(num_classes), repeat=num_pois)
    expected = [(*classes, *bits) for classes in every for bits in looks]
    classes, seen = episodes.every_state(*sizes)
    np.testing.assert_array_equal(
        np.concatenate([classes, seen.reshape(len(seen), -1)], axis=1), expected
    )


@pytest.mark.parametrize(
    "sizes", [(8, 9, 1), (8, 4, 2), (15, 3, 2), (17, 3, 2), (18, 3, 2), (25, 3, 2), (25, 4, 4)]
)
def test_of_more_states_than_an_integer_holds_an_even_sample_is_taken(sizes):
    num_pois, num_classes, num_modalities = sizes
    classes, seen = episodes.every_state(*sizes)
    assert seen.shape == (4096, num_pois, num_modalities)
    looks = seen.reshape(4096, -1).astype(int)
    assert len(np.unique(np.concatenate([classes, looks], axis=1), axis=0)) == 4096
    # Every class and look is as frequent as it should be, and related to no other: four standard
    # errors, five for the many pairs.
    shares = np.stack([np.mean(classes == c, axis=0) for c in range(num_classes)])
    p = 1 / num_classes
    np.testing.assert_allclose(shares, p, atol=4 * np.sqrt(p * (1 - p) / 4096))
    np.testing.assert_allclose(looks.mean(axis=0), 0.5, atol=4 * np.sqrt(0.25 / 4096))
    pairs = np.corrcoef(looks.T) - np.eye(looks.shape[1])
    assert np.max(np.abs(pairs)) < 5 / np.sqrt(4096)
    again = episodes.every_state(*sizes)
    np.testing.assert_array_equal(again[0], classes)
    np.testing.assert_array_equal(again[1], seen)


@pytree
class OfLooks:
    """What a look by the camera, or 10 times that by the LiDAR, says for each of three classes."""

    def log_likelihoods(self, features, modality):
        return jnp.array([1.0, 2.0, 4.0]) * features[0] * (1, 10)[modality]


@pytest.mark.parametrize("modality", [0, 1, jnp.int32(1)])
def test_policies_know_looks_and_the_exact_posterior(modality):
    # Features are the class, 0 to 2. Class 1 by both at first, class 2 by the LiDAR.
    seen, told = np.array([[0, 0], [1, 1], [0, 1]]), []
    first = seen.sum()

    def act(key, known):
        jax.debug.callback(
            lambda *x: told.append(x), known.looks, known.log_posterior, ordered=True
        )
        return jnp.array([2, 1, 2, NOP])[jnp.sum(known.looks) - first]

    begun = episodes.reset(KEY, MDP, OfLooks(), jnp.array([0, 1, 2]), jnp.array(seen, bool))
    found = episodes.run_episode(KEY, MDP.of(modality), OfLooks(), forgetting(act), begun)
    jax.block_until_ready(found)
    factors = np.array([0.0, 11.0, 20.0])
    for action, (looks, posterior) in zip((2, 1, 2, None), told, strict=True):
        np.testing.assert_array_equal(looks, seen)
        found = np.asarray(posterior) - np.asarray(posterior)[:, :1]
        # Logarithms of ratios to the first class: 2 - 1 and 4 - 1 for each unit of a feature.
        np.testing.assert_allclose(found, factors[:, None] * [0, 1, 3], rtol=1e-5)
        if action is not None:
            seen[action, int(modality)] += 1
            factors[action] += action * (1, 10)[int(modality)]
