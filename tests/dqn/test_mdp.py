"""The MDP of one robot on looks without networks, whose rewards are worked by hand."""

import itertools
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from toys import classes_mdp, noisy_mdp

from jaxsense.core.types import Belief, pytree
from jaxsense.dqn import mdp as mdps
from jaxsense.dqn import starts
from jaxsense.dqn.agent import Agent
from jaxsense.dqn.rewards import Paper

NOP = 3
MDP = classes_mdp()
UNSEEN_STD = 4.472136  # sqrt(20)
CLASSES = jnp.array([0, 1, 2])
SEEN = jnp.array([[False, False], [True, False], [True, True]])


@jax.jit
def reset(key, classes, seen):
    return starts.reset(key, MDP, classes, seen)


@jax.jit
def camera_step(state, action):
    return mdps.step(jax.random.key(0), MDP.of(0), state, action)


@jax.jit
def lidar_step(state, action):
    return mdps.step(jax.random.key(0), MDP.of(1), state, action)


def start(seen=SEEN):
    return reset(jax.random.key(0), CLASSES, seen)


def test_state_is_mean_and_deviation_of_one_poi_after_the_other():
    belief = Belief(jnp.array([[1.0, 2.0], [5.0, 6.0]]), jnp.array([[3.0, 4.0], [7.0, 8.0]]))
    observed = Agent(0.5, 0.0, None, 2, 2, 2, ()).observe(belief, None, None, 0)  # pyright: ignore
    np.testing.assert_array_equal(observed, [1, 2, 3, 4, 5, 6, 7, 8])


def test_reset_writes_what_has_been_seen_and_nothing_else():
    state = start()
    np.testing.assert_array_equal(state.seen, SEEN)
    np.testing.assert_array_equal(state.classes, CLASSES)
    np.testing.assert_allclose(
        state.belief.std, [[UNSEEN_STD, UNSEEN_STD], [3.0, 4.0], [0.6, 0.8]], rtol=1e-6
    )
    # The mean is (class, last modality): PoI 1 was seen by modality 0, PoI 2 by both.
    np.testing.assert_array_equal(state.belief.mean[:2], [[0.0, 0.0], [1.0, 0.0]])
    assert state.belief.mean[2, 0] == 2.0
    assert state.steps == 0


def test_reset_writes_the_modalities_in_random_order():
    seen = jnp.ones((3, 2), bool)
    states = jax.vmap(reset, in_axes=(0, None, None))(
        jax.random.split(jax.random.key(0), 400), CLASSES, seen
    )
    last = np.asarray(states.belief.mean[:, :, 1])
    # A fair coin for each PoI: 1/2 +- 4 sqrt(.25 / 400) = +- .1; two agree half of the time.
    np.testing.assert_allclose(last.mean(axis=0), 0.5, atol=0.1)
    np.testing.assert_allclose(np.mean(last[:, 0] == last[:, 1]), 0.5, atol=0.1)


@pytest.mark.parametrize(
    ("action", "modality", "expected"),
    [
        (0, 1, 0.2 - 0.158114),  # a first look pays its gain of information
        (1, 1, 1.0 - 0.2),  # what the other has seen pays more
        (1, 0, -1.0),  # a second look with the same sensor
        (2, 0, -1.0),
        (2, 1, -1.0),
    ],
)
def test_a_look_pays_its_gain_or_costs_one(action, modality, expected):
    step = (camera_step, lidar_step)[modality]
    after, outcome = step(start(), jnp.int32(action))
    np.testing.assert_allclose(outcome.reward, expected, rtol=1e-4)
    assert not outcome.terminated | outcome.truncated
    assert after.steps == 1
    assert after.seen[action, modality]
    np.testing.assert_array_equal(after.belief.mean[action], [action, modality])


def test_the_reward_of_the_paper_is_a_gain_above_the_threshold_or_minus_one():
    gains = jnp.array([[0.5, 0.26, 0.25], [0.1, 0.0, -2.0]])
    expected = [[0.5, 0.26, -1.0], [-1.0, -1.0, -1.0]]
    np.testing.assert_allclose(Paper(0.25).of_gain(gains), expected)
    assert np.isnan(Paper(0.25).of_gain(jnp.float32(jnp.nan)))


@pytree
class OfMean:
    """A user's own reward: 10 and 2 for the numbers of a belief's mean, and -.5 for a look."""

    def information(self, belief, probabilities):
        return 10 * belief.mean[0] + 2 * belief.mean[1]

    def of_gain(self, gain):
        return gain - 0.5


def test_a_step_is_rewarded_by_the_reward_of_its_mdp():
    # A belief's mean is (class, last modality), and (0, 0) before; the LiDAR is modality 1.
    mdp = replace(classes_mdp(), reward=OfMean())
    # PoI 0 unseen, of class 0: 2 - 0. PoI 1 of class 1, seen by the camera: 12 - 10. Of PoI 2 in
    # class 2, seen by the LiDAR, no more is left.
    seen = jnp.array([[0, 0], [1, 0], [0, 1]], bool)
    state = starts.reset(jax.random.key(0), mdp, CLASSES, seen)
    for action, expected in ((0, 1.5), (1, 1.5), (2, -0.5), (NOP, 0.0)):
        _, outcome = mdps.step(jax.random.key(0), mdp.of(1), state, jnp.int32(action))
        assert outcome.reward == expected


@pytree
class OfEachClass:
    """Returns a number for each class where a reward is one number."""

    def information(self, belief, probabilities):
        return probabilities

    def of_gain(self, gain):
        return gain


def test_a_reward_of_several_numbers_is_refused():
    with pytest.raises(ValueError, match=r"reward of a look has the shape \(3,\): must be \(\)"):
        mdps.step(jax.random.key(0), replace(MDP, reward=OfEachClass()).of(0), start(), 0)


def test_a_look_changes_the_belief_and_the_seen_bit_of_its_poi_alone():
    before = start(seen=jnp.zeros((3, 2), bool))
    for poi in range(3):
        after, _ = lidar_step(before, jnp.int32(poi))
        expected = np.zeros((3, 2), bool)
        expected[poi, 1] = True
        np.testing.assert_array_equal(after.seen, expected)
        others = np.arange(3) != poi
        np.testing.assert_array_equal(after.belief.mean[others], before.belief.mean[others])
        np.testing.assert_array_equal(after.belief.std[others], before.belief.std[others])
        assert after.belief.std[poi, 0] == 3.0


def test_nop_gives_nothing_ends_the_episode_and_leaves_the_map():
    before = start()
    after, outcome = lidar_step(before, jnp.int32(NOP))
    assert outcome.reward == 0.0
    assert outcome.terminated
    assert not outcome.truncated
    for name in ("belief", "seen", "classes", "scene"):
        jax.tree.map(np.testing.assert_array_equal, getattr(after, name), getattr(before, name))


def test_an_episode_is_cut_after_max_steps():
    mdp, state, cut = classes_mdp(max_steps=3), start(), []
    for _ in range(3):
        state, outcome = mdps.step(jax.random.key(0), mdp.of(0), state, jnp.int32(0))
        cut.append(bool(outcome.truncated))
        assert not outcome.terminated
    assert cut == [False, False, True]
    # An episode that NOP ends is not cut as well.
    late = replace(state, steps=jnp.int32(2))
    _, outcome = mdps.step(jax.random.key(0), mdp.of(0), late, jnp.int32(NOP))
    assert outcome.terminated
    assert not outcome.truncated


def permute(state, order):
    return replace(
        state,
        belief=jax.tree.map(lambda x: x[order], state.belief),
        seen=state.seen[order],
        classes=state.classes[order],
        scene=state.scene[order],
    )


ORDERS = jnp.array(list(itertools.permutations(range(3))))


@pytest.mark.parametrize("mdp", [MDP, noisy_mdp()], ids=["classes", "noisy"])
@pytest.mark.parametrize("modality", [0, 1])
def test_permuting_pois_permutes_what_a_step_does(mdp, modality):
    state = starts.reset(jax.random.key(0), mdp, jnp.array([2, 0, 1]), SEEN)

    def both_ways(order, action):
        # PoI n of the permuted state is PoI order[n] of the other.
        action_there = jnp.append(order, NOP)[action]
        key = jax.random.key(1)
        here, outcome = mdps.step(key, mdp.of(modality), permute(state, order), action)
        outcome = replace(outcome, poi=jnp.append(order, NOP)[outcome.poi])
        there, outcome_there = mdps.step(key, mdp.of(modality), state, action_there)
        return (here, outcome), (permute(there, order), outcome_there)

    pairs = jax.vmap(jax.vmap(both_ways, in_axes=(None, 0)), in_axes=(0, None))
    here, there = jax.jit(pairs)(ORDERS, jnp.arange(4))
    jax.tree.map(np.testing.assert_array_equal, here, there)
    assert len(np.unique(here[1].reward)) >= 2  # the actions differ


@pytest.fixture(scope="module")
def many_starts():
    keys = jax.random.split(jax.random.key(0), 12_400)
    classes, seen = jax.jit(jax.vmap(lambda key: starts.random_start(key, MDP)))(keys)
    return np.asarray(classes), np.asarray(seen)


def test_slots_draw_their_classes_independently(many_starts):
    classes, _ = many_starts
    _, counts = np.unique(classes @ [9, 3, 1], return_counts=True)
    # All 27 combinations, 12400 / 27 = 459 of each: chi-square of 26 degrees of freedom, p = 1e-4.
    assert len(counts) == 27
    assert np.sum((counts - 12_400 / 27) ** 2 / (12_400 / 27)) < 61.7
    # The same class in two slots: 1/3 +- 4 sqrt(1/3 x 2/3 / 12400) = +- .017.
    for i, j in ((0, 1), (0, 2), (1, 2)):
        np.testing.assert_allclose(np.mean(classes[:, i] == classes[:, j]), 1 / 3, atol=0.017)


def test_partly_seen_starts_are_uniform_over_all_but_all_and_nothing(many_starts):
    _, seen = many_starts
    codes = seen.reshape(-1, 6) @ (1 << np.arange(6))
    counts = np.bincount(codes, minlength=64)
    assert counts[0] == 0
    assert counts[63] == 0
    # 62 codes, 200 of each: chi-square of 61 degrees of freedom, p = 1e-4.
    assert np.sum((counts[1:63] - 200) ** 2 / 200) < 110.0
