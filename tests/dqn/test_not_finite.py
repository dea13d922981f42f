"""What is not a number shows: in rewards, actions, totals and the flag of an epoch."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from toys import Certain, Ignorant, Toy, agent_of, classes_mdp, paying_once_mdp, policy

from jaxsense.config import DqnConfig
from jaxsense.core.types import Belief, pytree
from jaxsense.dqn import episodes, starts, training
from jaxsense.dqn import mdp as mdps
from jaxsense.dqn.agent import Environment

MDP, NOP, KEY = classes_mdp(), 3, jax.random.key(0)
FAST_TO_COMPILE = {"xla_backend_optimization_level": 0}


def start(mdp=MDP):
    return starts.reset(KEY, mdp, jnp.array([0, 1, 2]), jnp.zeros((3, 2), bool))


@pytest.mark.parametrize("action", [-1, NOP + 1])
def test_an_action_that_is_none_pays_nan(action):
    # Traced, it cannot be refused; known before, it is.
    step = jax.jit(lambda action: mdps.step(KEY, MDP.of(0), start(), action)[1])
    outcome = step(jnp.int32(action))
    assert np.isnan(outcome.reward)
    assert not outcome.terminated


@pytest.mark.parametrize("worst", [0, 2, 3])
def test_values_that_are_not_numbers_choose_no_action_and_total_nan(worst):
    agent = agent_of(MDP, (4,))
    params = agent.init(KEY)["params"]
    bias = jnp.array([0.0, 1.0, 2.0, 9.0]).at[worst].set(jnp.nan)
    layers = {"params": {**params, "Dense_1": {**params["Dense_1"], "bias": bias}}}
    latent = policy("latent", agent=agent, q_networks=(layers,) * 2, fusion=MDP.fusion)
    told = []

    def act(key, known, memory):
        action = latent(key, known)
        jax.debug.callback(told.append, action)
        return action, memory

    begun = episodes.reset(KEY, MDP, Ignorant())
    total, first = episodes.run_episode(KEY, MDP, Ignorant(), act, begun)
    assert np.isnan(total)
    assert np.isnan(first)
    jax.effects_barrier()
    assert set(map(int, told)) == {-1}


CONFIG = DqnConfig(
    task="map",
    hidden=(4,),
    num_envs=4,
    epochs=2,
    updates=1,
    batch=4,
    replay_capacity=4000,
    epsilon_min=1.0,
)


@pytree
class Shown(Certain):
    """A look shows the number that is the scene."""

    def scene(self, key, classes):
        return jnp.float32(1.0)

    def observe(self, key, scene, poi, modality, distance):
        return scene[None], scene


@pytree
class Wide(Toy):
    """A look leaves as much doubt as it shows."""

    def update(self, belief, seen, features, modality, weight=1.0):
        return Belief(belief.mean, jnp.full(2, 1.0) * features)


PAYING = paying_once_mdp()
SCENE_MDP = replace(PAYING, looks=Shown(1), fusion=Wide(PAYING.fusion.prior, 1))
SCENE = Environment(agent_of(SCENE_MDP, CONFIG.hidden), SCENE_MDP)


@pytest.fixture(scope="module")
def chunk():
    """Two epochs of exploration, and where they start."""
    prepared = training.starts(KEY, SCENE, CONFIG)
    state = training.init(KEY, SCENE, CONFIG, prepared)

    def run(state, prepared):
        return training.train_chunk(KEY, SCENE, CONFIG, state, prepared)

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
    scene = jnp.full_like(prepared.now.scene, jnp.nan)
    now = replace(prepared.now, scene=scene)
    _, info = run(with_memories(state), replace(prepared, now=now))
    assert np.isfinite(info.loss).all()
    np.testing.assert_array_equal(info.is_finite, [False, False])
