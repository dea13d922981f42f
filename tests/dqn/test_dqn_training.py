"""Deep Q-learning on a probe whose values are known, and the bookkeeping around it."""

import functools
from dataclasses import replace

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from toys import ONCE_Q, ONCE_SEEN, agent_of, paying_once_mdp

from jaxsense.config import DqnConfig
from jaxsense.dqn import replay, starts, training
from jaxsense.dqn.agent import Environment
from jaxsense.dqn.team import alone

# Every episode is cut after one action: no value could be learnt beyond it, were a cut an end.
MDP = paying_once_mdp(num_pois=2, max_steps=1)
FAST_TO_COMPILE = {"xla_backend_optimization_level": 0}
PROBE = DqnConfig(
    num_envs=32,
    epochs=800,
    updates=2,
    batch=64,
    replay_capacity=4096,
    discount=0.5,
    learning_rate=1e-2,
    epsilon_min=0.5,
    target_period=20,
)


def learning_in(mdp, config):
    return Environment(agent_of(mdp, config.hidden, config.discount), mdp)


SMALL = DqnConfig(
    hidden=(8,),
    num_envs=8,
    epochs=13,  # chunks of one
    updates=1,
    batch=8,
    replay_capacity=64,
    epsilon_decay=0.5,
    epsilon_min=0.1,
    target_period=3,
)


LEARNING = learning_in(MDP, SMALL)


@jax.jit
def begin(init_key, start_key, learning, config):
    prepared = training.starts(start_key, learning, config)
    return prepared, training.init(init_key, learning, config, prepared)


def chunk_of(learning, config, prepared):
    """The state and the infos after a chunk."""
    chunk = functools.partial(training.train_chunk, jax.random.key(1), learning, config)
    return jax.jit(lambda state: chunk(state, prepared), compiler_options=FAST_TO_COMPILE)


def with_bias(params, bias):
    """A network whose values are the same for every state."""
    layers = jax.tree.map(jnp.zeros_like, params["params"])
    return {"params": {**layers, "Dense_1": {**layers["Dense_1"], "bias": jnp.array(bias)}}}


def states():
    classes = jnp.zeros(2, int)
    reset = lambda seen: starts.reset(jax.random.key(0), MDP, classes, seen)  # noqa: E731
    return jax.jit(jax.vmap(reset))(ONCE_SEEN)


@jax.jit
def values(params):
    """`[4, 3]` values in the states above."""
    agent = learning_in(MDP, PROBE).agent
    team, times = alone(2, 0), jnp.ones((1, 2))
    observed = jax.vmap(lambda b: agent.observe(b, team, times, jnp.int32(0)))(states().belief)
    return agent.values(params, observed.T).T


@pytest.fixture(scope="module")
def probe():
    """Two seeds of the probe."""
    learning = learning_in(MDP, PROBE)
    train = jax.vmap(lambda key: training.train(key, learning, PROBE))
    train = jax.jit(train, compiler_options=FAST_TO_COMPILE)
    return train(jax.random.split(jax.random.key(0), 2))


@pytest.mark.parametrize("seed", [0, 1])
def test_values_are_those_worked_by_hand(probe, seed):
    params = jax.tree.map(lambda x: x[seed], probe[0].params)
    np.testing.assert_allclose(values(params), ONCE_Q, atol=0.05)
    np.testing.assert_array_equal(probe[1].episodes, PROBE.num_envs)  # all are cut after one action


def test_returns_of_exploring_and_learnt_behaviour(probe):
    _, info = probe
    # At random: .5 x .8 - .5 x 1 for a look and 0 for NOP, so -.1 x 2/3 = -.067. The best takes
    # .8 in 3 of 4 starts: .6; with epsilon = .5 it is (.6 - .067) / 2 = .267.
    np.testing.assert_allclose(info.episode_return[:, :5].mean(), -0.067, atol=0.15)
    np.testing.assert_allclose(info.episode_return[:, -400:].mean(), 0.267, atol=0.05)


@pytest.fixture(scope="module")
def chunks():
    """States of a small training after every epoch, and the infos, stepped from the host."""
    config = SMALL
    init_key, start_key, chunk_key = jax.random.split(jax.random.key(0), 3)
    prepared, first = begin(init_key, start_key, LEARNING, config)

    @chex.assert_max_traces(n=1)  # a second chunk must not be traced again
    def chunk(key, state):
        return training.train_chunk(key, LEARNING, config, state, prepared)

    chunk = jax.jit(chunk, compiler_options=FAST_TO_COMPILE)
    all_states, infos = [first], []
    for key in jax.random.split(chunk_key, config.epochs):
        state, info = chunk(key, all_states[-1])
        all_states.append(state)
        infos.append(info)
    return all_states, jax.tree.map(lambda *x: jnp.concatenate(x), *infos)


def test_an_update_draws_as_many_blocks_as_make_a_batch():
    config = replace(PROBE, num_envs=128, batch=256)  # in 64 blocks
    keys = jax.random.split(jax.random.key(0), 3)
    draws = jax.eval_shape(lambda keys: training._draw(keys, config), keys)
    assert draws.replay.shape == (config.chunk, 2, 64, 2)


def test_epsilon_falls_by_its_factor_every_epoch_down_to_the_floor(chunks):
    np.testing.assert_allclose(chunks[1].epsilon[:6], [1.0, 0.5, 0.25, 0.125, 0.1, 0.1])


def test_target_is_a_copy_from_the_last_multiple_of_its_period(chunks):
    all_states, _ = chunks
    for epoch, state in enumerate(all_states):
        copied_at = epoch // SMALL.target_period * SMALL.target_period
        source = all_states[copied_at].params
        jax.tree.map(np.testing.assert_array_equal, state.target, source)
        if epoch:
            before = jax.tree.leaves(all_states[epoch - 1].params)
            leaves = jax.tree.leaves(state.params)
            assert not all(np.array_equal(x, y) for x, y in zip(leaves, before, strict=True))


def test_training_in_one_call_equals_chunks_with_the_same_keys(chunks):
    all_states, infos = chunks
    train = lambda key: training.train(key, LEARNING, SMALL)  # noqa: E731
    state, info = jax.jit(train, compiler_options=FAST_TO_COMPILE)(jax.random.key(0))
    chex.assert_trees_all_close((state, info), (all_states[-1], infos), rtol=1e-5, atol=1e-6)


def test_an_episode_goes_on_until_nop_or_the_cut(monkeypatch):
    monkeypatch.setattr(training, "_FIRST_EPSILON", 0.0)
    mdp = paying_once_mdp(num_pois=1, max_steps=3)
    # A tall bias makes the network look for ever; epsilon is 0.
    few = {"hidden": (4,), "num_envs": 4, "epochs": 7, "batch": 4}
    config = replace(SMALL, **few, learning_rate=1e-9, discount=0.5, epsilon_min=0.0)
    learning = learning_in(mdp, config)
    prepared, state = begin(jax.random.key(0), jax.random.key(2), learning, config)
    state = replace(state, params=with_bias(state.params, [1e3, -1e3]))
    chunk, infos = chunk_of(learning, config, prepared), []
    for _ in range(config.epochs // config.chunk):
        state, info = chunk(state)
        infos.append(info)
    info = jax.tree.map(lambda *parts: np.concatenate(parts), *infos)
    np.testing.assert_array_equal(info.episodes, [0, 0, 4, 0, 0, 4, 0])
    # Three looks at one PoI: .8 - 1 - 1 if it had not been seen, else -3.
    ended = np.asarray(info.episode_return)[[2, 5]]
    seen_before = np.round((-1.2 - ended) / 1.8 * 4)  # of 4 episodes
    np.testing.assert_allclose(ended, -1.2 - 1.8 * seen_before / 4, atol=1e-5)
    np.testing.assert_array_equal(np.asarray(info.episode_return)[[0, 1, 3, 4, 6]], 0.0)
    np.testing.assert_array_equal(state.done, False)
    np.testing.assert_array_equal(state.envs.now.steps, 1)
    # A cut is no end, so the discount is that of the settings and never 0 here.
    drawn = replay.sample(jax.random.uniform(jax.random.key(3), (64, 2)), state.replay)
    np.testing.assert_array_equal(drawn.discount_t, config.discount)
    assert set(np.asarray(drawn.a_tm1)) == {0}


def test_values_after_an_action_are_those_of_the_target_network(monkeypatch):
    monkeypatch.setattr(training, "_FIRST_EPSILON", 0.0)
    # Nothing is left to see: every look costs 1, and the policy looks at PoI 0 for ever.
    mdp = paying_once_mdp(num_pois=1, max_steps=9)
    config = replace(
        SMALL, discount=0.5, epsilon_min=0.0, epochs=2, target_period=2, learning_rate=1e-9
    )
    seen = jnp.ones((1, 1), bool)

    learning = learning_in(mdp, config)

    @jax.jit
    def begin_there():
        one = starts.reset(jax.random.key(0), mdp, jnp.zeros(1, int), seen)
        prepared = jax.tree.map(lambda x: jnp.stack([x] * config.num_starts), learning.begin(one))
        return prepared, training.init(jax.random.key(0), learning, config, prepared)

    prepared, state = begin_there()
    state = replace(
        state,
        params=with_bias(state.params, [1.0, 0.0]),
        target=with_bias(state.params, [-2.0, 3.0]),
    )
    chunk = chunk_of(learning, config, prepared)
    state, first = chunk(state)
    _, second = chunk(state)
    # The value of the look is 1. By the target -1 + .5 x max(-2, 3) - 1 = -.5, and from its first
    # copy on, after two epochs, -1 + .5 x max(1, 0) - 1 = -1.5: sqrt(1 + e^2) - 1.
    losses = np.sqrt(1 + np.array([0.5, 0.5, 1.5, 1.5]) ** 2) - 1
    np.testing.assert_allclose([*first.loss, *second.loss], losses, rtol=1e-5)


def length_of(key, params):
    """A number that any change of the parameters changes."""
    return sum(jnp.sum(jnp.abs(x)) for x in jax.tree.leaves(params))


@functools.partial(jax.jit, static_argnames="evaluate", compiler_options=FAST_TO_COMPILE)
def train_from_epoch_5(config, evaluate):
    prepared = training.starts(jax.random.key(2), LEARNING, config)
    state = training.init(jax.random.key(0), LEARNING, config, prepared)
    state = replace(state, epoch=jnp.int32(5))
    return training.train_chunk(jax.random.key(1), LEARNING, config, state, prepared, evaluate)


def test_the_policy_is_evaluated_after_every_tenth_epoch():
    # The target network is a copy of the parameters after epochs 15, 30 and so on: in a chunk that
    # begins after epoch 5 and ends after epoch 25, of those after its tenth.
    state, infos = train_from_epoch_5(replace(SMALL, epochs=20, target_period=15), length_of)
    np.testing.assert_array_equal(np.flatnonzero(~np.isnan(infos.evaluation_return)), [9, 19])
    found = infos.evaluation_return[jnp.array([9, 19])]
    expected = [length_of(None, params) for params in (state.target, state.params)]
    np.testing.assert_allclose(found, expected, rtol=1e-6)
    assert found[0] != found[1]


Q_TM1, Q_T = jnp.array([1.0, 2.0, 3.0]), jnp.array([-1.0, 4.0, 0.0])


def test_td_errors_as_worked_by_hand():
    # .5 + .9 x max(-1, 4, 0) - 2 = 2.1; for action 2, .5 + 3.6 - 3 = 1.1; at an end, .25 - 1.
    q_tm1, q_t = (jnp.stack([q] * 3, axis=1) for q in (Q_TM1, Q_T))
    discounts, rewards = jnp.array([0.9, 0.9, 0.0]), jnp.array([0.5, 0.5, 0.25])
    found = training.td_error(q_tm1, jnp.array([1, 2, 0]), rewards, discounts, q_t)
    np.testing.assert_allclose(found, [2.1, 1.1, -0.75], rtol=1e-6)


def test_no_gradient_flows_into_the_target():
    action, r_t, discount = jnp.int32(1), jnp.float32(0.5), jnp.float32(0.9)
    error = lambda q_tm1, q_t: training.td_error(q_tm1, action, r_t, discount, q_t)  # noqa: E731
    by_value, by_target = jax.grad(error, argnums=(0, 1))(Q_TM1, Q_T)
    np.testing.assert_array_equal(by_value, [0.0, -1.0, 0.0])
    np.testing.assert_array_equal(by_target, [0.0, 0.0, 0.0])


def test_pseudo_huber_as_worked_by_hand():
    # sqrt(1 + 9/16) - 1 = 5/4 - 1; sqrt(1 + 576/49) - 1 = 25/7 - 1.
    errors = jnp.array([0.0, 0.75, -0.75, 24 / 7])
    np.testing.assert_allclose(training.pseudo_huber(errors), [0, 0.25, 0.25, 18 / 7], rtol=1e-6)
