"""The policies to compare with, on the toy map."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from toys import classes_mdp, noisy_mdp

from jaxsense.dqn import belief_mdp, policies

MDP, NOP, KEY = classes_mdp(), 3, jax.random.key(0)
# The camera tells class 0 from the others, the LiDAR class 2.
LABELS = jnp.array([[1, 0, 0], [0, 0, 1]])


reset = jax.jit(lambda classes, seen: belief_mdp.reset(KEY, MDP, classes, seen))


def start(seen):
    return reset(jnp.array([0, 1, 2]), jnp.array(seen, bool))


@pytest.fixture(scope="module")
def rewards():
    """Of the LiDAR's looks."""
    return jax.jit(lambda: policies.expected_rewards(KEY, MDP, 1, num_draws=2))()


@pytest.mark.parametrize(
    ("seen_by_camera", "expected"),
    [((0, 0, 0), 0), ((1, 0, 0), 1), ((0, 1, 1), 0), ((1, 1, 0), 2), ((1, 1, 1), NOP)],
)
def test_naive_looks_at_the_first_poi_the_own_sensor_has_not_seen(seen_by_camera, expected):
    seen = np.array([seen_by_camera, (1, 0, 1)]).T  # what the LiDAR has seen does not matter
    assert policies.naive(MDP, 0)(KEY, start(seen)) == expected
    assert policies.naive(MDP, 1)(KEY, start(seen[:, ::-1])) == expected


@pytest.mark.parametrize(
    ("seen", "expected"),
    [
        (((1, 1), (1, 0), (1, 1)), 1),  # only PoI 1 is left for the LiDAR
        (((1, 1), (0, 1), (0, 1)), NOP),  # the LiDAR has seen all
        (((0, 0), (0, 1), (1, 0)), 2),  # 1 - .2 = .8 pays more than .2 - .158
        (((0, 0), (0, 1), (0, 1)), 0),
    ],
)
def test_optimal_takes_the_look_that_pays_most_or_else_nop(rewards, seen, expected):
    assert policies.optimal(MDP, rewards, LABELS)(KEY, start(seen)) == expected


def test_expected_rewards_of_each_look(rewards):
    # Nobody, camera, LiDAR, both: .2 - 1 / sqrt(40) = .041886; 1 - .2 = .8; twice in vain.
    table = np.repeat([[0.041886], [0.8], [-1.0], [-1.0]], 3, axis=1)
    np.testing.assert_allclose(rewards, table, rtol=1e-4)


def test_expected_rewards_average_over_the_draws():
    mdp = noisy_mdp()  # every look gains a uniform number of its own
    rewards = jax.jit(lambda: policies.expected_rewards(KEY, mdp, 0, num_draws=400))()
    # 1/2 +- 4 sqrt(1/12 / 400) = +- .058, by different draws for each entry.
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
def test_optimal_averages_over_the_classes_that_the_looks_leave_open(rewards_of_classes, expected):
    rewards = jnp.broadcast_to(jnp.array(rewards_of_classes), (4, 3))
    seen = jnp.array([(0, 0), (0, 1), (0, 1)], bool)
    state = reset(jnp.array([1, 1, 2]), seen)
    assert policies.optimal(MDP, rewards, LABELS)(KEY, state) == expected


def test_uniform_takes_every_action_equally_often():
    keys = jax.random.split(KEY, 4000)
    actions = jax.vmap(policies.random(MDP), in_axes=(0, None))(keys, start(np.zeros((3, 2))))
    # 1000 each +- 4 sqrt(4000 x 3/16) = +- 110.
    np.testing.assert_allclose(np.bincount(actions, minlength=4), 1000, atol=110)


def test_greedy_takes_the_action_of_highest_value():
    network = policies.q_network(MDP.num_pois, (4,))
    params = network.init(KEY, jnp.zeros(12))
    state = start(np.zeros((3, 2)))
    for best in range(4):
        bias = 100.0 * (jnp.arange(4) == best)
        layers = {**params["params"], "Dense_1": {**params["params"]["Dense_1"], "bias": bias}}
        assert policies.greedy(MDP, {"params": layers}, (4,))(KEY, state) == best


def test_rewards_of_one_poi_and_three_modalities():
    mdp = classes_mdp(num_pois=1, num_modalities=3)
    rewards = jax.jit(lambda: policies.expected_rewards(KEY, mdp, 1, num_draws=2))()
    # By who has looked, first modality in the lowest bit: nobody .2 - .158114, one other 1 - .2,
    # both others 2 - 1, and in vain where the own bit is set.
    of_codes = [0.041886, 0.8, -1.0, -1.0, 0.8, 1.0, -1.0, -1.0]
    np.testing.assert_allclose(rewards, np.repeat(of_codes, 3).reshape(8, 3), rtol=1e-4)
    act = policies.optimal(mdp, rewards, jnp.zeros((3, 3), int))
    start = jax.jit(lambda seen: belief_mdp.reset(KEY, mdp, jnp.array([2]), seen))
    for seen, expected in (((0, 0, 1), 0), ((0, 1, 1), 1)):
        state = start(jnp.array([seen], bool))
        assert act(KEY, state) == expected
