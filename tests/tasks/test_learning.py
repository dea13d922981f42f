"""Our own Q-networks in frozen tasks: what they read, where they learn and how they act."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.tree_util import Partial

import jaxsense
from jaxsense import tasks
from jaxsense.tasks.score import _play_compiled
from jaxsense.tasks.task import CLIP, Scaling

make = functools.cache(jaxsense.make)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["map-v0", "team-v0"])
def test_a_network_reads_from_an_observation_what_it_learns_from(name):
    task = make(name)
    learning = task.learning(task.models.agent)

    @jax.jit
    def read(key):
        start_key, *keys = jax.random.split(key, 4)
        state = learning.reset(start_key)
        for i, step_key in enumerate(keys):
            state = learning.step(step_key, state, learning.observe(state), jnp.int32(i))[0]
        seen = task.observe(state.now)
        return learning.observe(state), task.inputs(seen), jnp.abs(seen).max()

    expected, found, largest = jax.vmap(read)(jax.random.split(jax.random.key(0), 32))
    is_whole = np.asarray(largest) < CLIP
    assert is_whole.sum() > 16
    np.testing.assert_allclose(found[is_whole], expected[is_whole], atol=1e-4)


def test_presence_is_read_without_rounding():
    task, rng = make("team-v0"), np.random.default_rng(0)
    seen = rng.normal(size=task.observation_size).astype(np.float32)
    features = np.array(task.scaling.inverse(seen))
    features[:, -3] = np.arange(len(features)) % 2
    found = task.inputs(task.scaled(features)).reshape(features.T.shape)
    np.testing.assert_array_equal(found[-3], features[:, -3])
    np.testing.assert_allclose(found, features.T, atol=1e-4)


def test_scaling_is_inverted():
    scaling = Scaling(jnp.array([1.0, -2.0]), jnp.array([0.5, 4.0]))
    features = jnp.array([[0.5, 2.0], [2.0, -6.0]])
    np.testing.assert_allclose(scaling(features), [-1, 1, 2, -1])
    np.testing.assert_allclose(scaling.inverse(scaling(features)), features)


def test_a_q_network_takes_its_best_action():
    task = make("map-v0")
    agent = task.models.agent
    params = agent.init(jax.random.key(1))
    policy = tasks.greedy(task, agent, params)

    @jax.jit
    @jax.vmap
    def start(key):
        observation, _ = task.reset(key)
        return policy(key, observation), agent.values(params, task.inputs(observation))

    chosen, values = start(jax.random.split(jax.random.key(2), 64))
    np.testing.assert_array_equal(chosen, values.argmax(axis=1))
    assert len(np.unique(chosen)) > 1


def above(bound, key, observation):
    return jnp.where(observation[0] > bound, 0, 3)


@pytest.mark.slow
def test_policies_of_one_kind_are_compiled_once():
    task = make("map-v0")
    programs = _play_compiled._cache_size()
    keys = jax.random.split(jax.random.key(0), 3)
    found = [
        tasks.mean_return(keys[0], task, Partial(above, jnp.float32(bound)), 32)
        for bound in (-20.0, 0.0, 20.0)
    ]
    assert _play_compiled._cache_size() == programs + 1
    # The first looks at one PoI again and again, the last never.
    assert found[0] < 0 == found[2]
    # With another key, other starts; a function alone is a program of its own.
    alone = [tasks.mean_return(key, task, functools.partial(above, -20.0), 32) for key in keys]
    assert alone[0] == pytest.approx(found[0], abs=1e-5)
    assert len(set(alone)) == 3
