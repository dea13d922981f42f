"""What is not a number shows: in rewards, actions, totals and the flag of an epoch."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from toys import classes_mdp, paying_once_mdp

from jaxsense.config import DqnConfig
from jaxsense.core.types import Belief
from jaxsense.dqn import belief_mdp, episodes, policies, training

MDP, NOP, KEY = classes_mdp(), 3, jax.random.key(0)
FAST_TO_COMPILE = {"xla_backend_optimization_level": 0}


def start(mdp=MDP):
    return belief_mdp.reset(KEY, mdp, jnp.array([0, 1, 2]), jnp.zeros((3, 2), bool))


@pytest.mark.parametrize("action", [-1, NOP + 1])
def test_an_action_that_is_none_pays_nan(action):
    # Traced, it cannot be refused; known before, it is.
    step = jax.jit(lambda action: belief_mdp.step(KEY, MDP, start(), action, 0)[1])
    outcome = step(jnp.int32(action))
    assert np.isnan(outcome.reward)
    assert not outcome.terminated


def test_a_belief_that_is_not_a_number_pays_nan_and_not_a_look_in_vain():
    mdp = replace(MDP, write=lambda *look: Belief(jnp.zeros(2), jnp.full(2, jnp.nan)))
    step = jax.jit(lambda state, action: belief_mdp.step(KEY, mdp, state, action, 0))
    after, outcome = step(start(), jnp.int32(0))
    assert np.isnan(outcome.reward)
    # Nothing is looked at: nothing is wrong.
    assert step(after, jnp.int32(NOP))[1].reward == 0.0


@pytest.mark.parametrize("worst", [0, 2, 3])
def test_values_that_are_not_numbers_choose_no_action_and_total_nan(worst):
    params = policies.q_network(MDP.num_pois, (4,)).init(KEY, jnp.zeros(12))["params"]
    bias = jnp.array([0.0, 1.0, 2.0, 9.0]).at[worst].set(jnp.nan)
    greedy = policies.greedy(
        MDP, {"params": {**params, "Dense_1": {**params["Dense_1"], "bias": bias}}}, (4,)
    )
    assert greedy(KEY, start()) == -1
    total, first = episodes.run_episode(KEY, MDP, greedy, start(), 0)
    assert np.isnan(total)
    assert np.isnan(first)


def test_rewards_that_are_not_numbers_choose_no_action():
    labels = jnp.array([[1, 0, 0], [0, 0, 1]])
    rewards = jnp.ones((4, 3)).at[2, 1].set(jnp.nan)  # of class 1, after the LiDAR
    state = replace(start(), seen=jnp.zeros((3, 2), bool).at[1, 1].set(True))
    act = jax.jit(lambda rewards: policies.optimal(MDP, rewards, labels)(KEY, state))
    assert act(rewards) == -1


CONFIG = DqnConfig(
    hidden=(4,),
    num_envs=4,
    epochs=4,
    chunk=2,
    updates=1,
    batch=4,
    replay_capacity=4000,
    num_starts=4,
    epsilon_min=1.0,
)

# A look gains what the scene holds.
SCENE_MDP = replace(
    paying_once_mdp(),
    new_scene=lambda key, classes: jnp.float32(1.0),
    observe=lambda key, scene, poi, modality: (scene[None], scene),
    write=lambda belief, seen, features, modality: Belief(belief.mean, jnp.full(2, 1.0) * features),
)


@pytest.fixture(scope="module")
def chunk():
    """Two epochs of exploration, and where they start."""
    prepared = training.starts(KEY, SCENE_MDP, CONFIG)
    state = training.init(KEY, SCENE_MDP, CONFIG, prepared)

    def run(state, prepared):
        return training.train_chunk(KEY, SCENE_MDP, 0, CONFIG, state, prepared)

    return jax.jit(run, compiler_options=FAST_TO_COMPILE), state, prepared


def with_memories(state):
    """With so much in the replay, all zero, that what is new is hardly drawn."""
    return replace(state, replay=replace(state.replay, count=jnp.int32(990)))


def test_an_epoch_whose_numbers_are_all_finite_says_so(chunk):
    run, state, prepared = chunk
    np.testing.assert_array_equal(run(state, prepared)[1].is_finite, [True, True])


def test_one_parameter_that_is_not_finite_is_told_at_once(chunk):
    run, state, prepared = chunk
    layer = state.params["params"]["Dense_0"]
    bad = {**layer, "kernel": layer["kernel"].at[0, 0].set(jnp.nan)}
    params = {"params": {**state.params["params"], "Dense_0": bad}}
    _, info = run(replace(state, params=params), prepared)
    np.testing.assert_array_equal(info.is_finite, [False, False])


def test_one_reward_that_is_not_a_number_is_told_before_it_is_learnt_from(chunk):
    run, state, prepared = chunk
    _, info = run(with_memories(state), replace(prepared, scene=jnp.full(4, jnp.nan)))
    assert np.isfinite(info.loss).all()
    np.testing.assert_array_equal(info.is_finite, [False, False])


def test_a_gradient_that_is_not_a_number_is_told_in_its_epoch(chunk):
    run, state, prepared = chunk
    # The loss is still finite, and so are the values: the state of Adam alone is not.
    bad = jax.tree.map(lambda x: jnp.full_like(x, jnp.nan) if x.ndim else x, state.optimiser)
    _, info = run(replace(state, optimiser=bad), prepared)
    assert np.isfinite(info.loss[0])
    np.testing.assert_array_equal(info.is_finite, [False, False])
