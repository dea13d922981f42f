"""The reference of the map MDP, on rewards that are known."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from toys import classes_mdp, noisy_mdp

from jaxsense.dqn import episodes, policies

MDP, NOP, KEY = classes_mdp(), 3, jax.random.key(0)
# The camera tells class 0 from the others, the LiDAR class 2.
LABELS = jnp.array([[1, 0, 0], [0, 0, 1]])


@pytest.fixture(scope="module")
def rewards():
    """Of the LiDAR's looks."""
    return jax.jit(lambda: episodes.expected_rewards(KEY, MDP, 1, num_draws=2))()


def chosen(rewards, seen, classes=(0, 1, 2), labels=LABELS):
    seen, classes = jnp.array(seen, bool), jnp.array(classes)
    return policies.best(episodes._informed(rewards, labels, seen, classes))


def test_expected_rewards_average_over_the_draws():
    mdp = noisy_mdp()  # every look gains a uniform number of its own
    rewards = jax.jit(lambda: episodes.expected_rewards(KEY, mdp.of(0), num_draws=400))()
    # 1/2 +- 4 sqrt(1/12 / 400) = +- .058, by different draws for each number.
    np.testing.assert_allclose(rewards, 0.5, atol=0.058)
    assert len(np.unique(rewards)) == 12


@pytest.mark.parametrize(
    ("rewards_of_classes", "expected"),
    [
        # Unseen: (1 - 2 + 4) / 3 = 1. Seen round, class 0 or 1: (1 - 2) / 2. Seen edgy: 4.
        ((1.0, -2.0, 4.0), 2),
        # Unseen: (4 - 2 - 8) / 3 = -2. Seen round: (4 - 2) / 2 = 1. Seen edgy: -8.
        ((4.0, -2.0, -8.0), 1),
        # Nothing pays.
        ((-1.0, 0.5, -3.0), NOP),
    ],
)
def test_rewards_are_averaged_over_the_classes_that_looks_leave_open(rewards_of_classes, expected):
    rewards = jnp.broadcast_to(jnp.array(rewards_of_classes), (4, 3))
    assert chosen(rewards, ((0, 0), (0, 1), (0, 1)), classes=(1, 1, 2)) == expected


def test_rewards_of_one_poi_and_three_modalities():
    mdp = classes_mdp(num_pois=1, num_modalities=3)
    rewards = jax.jit(lambda: episodes.expected_rewards(KEY, mdp.of(1), num_draws=2))()
    # By who has looked, first modality in the lowest bit: nobody .2 - .158114, one other 1 - .2,
    # both others 2 - 1, and in vain where the own bit is set.
    of_codes = [0.041886, 0.8, -1.0, -1.0, 0.8, 1.0, -1.0, -1.0]
    np.testing.assert_allclose(rewards, np.repeat(of_codes, 3).reshape(8, 3), rtol=1e-4)
    for seen, expected in (((0, 0, 1), 0), ((0, 1, 1), 1)):
        assert chosen(rewards, [seen], [2], jnp.zeros((3, 3), int)) == expected


@pytest.mark.parametrize(
    ("accumulates", "number", "of_labels", "is_sound", "expected"),
    [
        (False, 16, False, False, True),  # as in the paper: rewards do not read probabilities
        (False, 16, True, False, False),
        (False, 16, True, True, True),
        (True, 3, False, True, True),
        (True, 3, False, False, False),
        (True, 16, False, True, False),  # a lattice of 16 classes is coarse
    ],
)
def test_where_an_optimum_can_be_had(accumulates, number, of_labels, is_sound, expected):
    fusion = SimpleNamespace(accumulates=accumulates, classes=SimpleNamespace(mean=range(number)))
    labels = np.zeros((2, 2)) if of_labels else None
    values = SimpleNamespace(labels=labels, q=range(2048))
    assert episodes.has_optimum(fusion, values, is_sound) is expected  # pyright: ignore
