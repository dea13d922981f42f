"""gymnax: parameters, prepared starts, batches and wrappers; `test_parity` has the steps."""

import jax
import numpy as np
import pytest
import small

pytest.importorskip("gymnax", reason="needs the extra jaxsense[gymnax]")

import gymnax
from gymnax.wrappers import purerl
from gymnax.wrappers.gym import GymnaxToGymWrapper

import jaxsense
from jaxsense.interfaces.gymnax import MapEnv

LIDAR, NOP = 1, 3


@pytest.fixture(scope="module")
def env():
    return MapEnv(small.small_mdp().of(LIDAR))


@pytest.fixture(scope="module")
def params(env):
    return env.prepared_params(jax.random.key(2), 5)


def test_params_say_when_an_episode_is_truncated(env, params):
    assert params.max_steps_in_episode == small.small_mdp().config.max_steps
    params = params.replace(max_steps_in_episode=2)
    _, state = env.reset(jax.random.key(0), params)
    cases = [(0, False, False), (0, False, True), (0, False, False), (NOP, True, False)]
    for action, *expected in cases:
        key = jax.random.key(action)
        seen, state, _, *ended, info = env.step(key, state, action, params)
        assert ended == expected
        assert info["discount"] == 1.0 - any(expected[:1])
        assert (state.time == 0) == any(expected)
    start, _ = env.reset(jax.random.split(key)[1], params)
    np.testing.assert_allclose(seen, start, rtol=1e-6)


def test_prepared_starts_are_drawn_and_no_others(env, params):
    keys = jax.random.split(jax.random.key(3), 100)
    drawn, _ = jax.vmap(env.reset, (0, None))(keys, params)
    starts = np.dstack([params.starts.belief.mean, params.starts.belief.std]).reshape(-1, 12)
    distances = np.abs(np.asarray(drawn)[:, None] - np.asarray(starts)[None]).max(axis=2)
    assert (distances.min(axis=1) == 0).all()
    assert (distances.min(axis=0) == 0).all()


def test_wrappers_of_gymnax_take_it(env, params):
    logged = purerl.LogWrapper(env)
    _, state = logged.reset(jax.random.key(0), params)
    *_, info = logged.step(jax.random.key(1), state, NOP, params)
    assert info["returned_episode_lengths"] == 1
    single = GymnaxToGymWrapper(env, params)
    obs, _ = single.reset(seed=0)
    assert single.observation_space.contains(np.asarray(obs))
    assert single.step(single.action_space.n - 1)[2]


def test_every_task_is_registered(env):
    assert set(jaxsense.registered()) <= set(gymnax.registered_envs)
    made, params = gymnax.make("map-v0", agent="lidar")
    assert (made.played.agent, made.played.name) == ("lidar", "map-v0")
    assert params.max_steps_in_episode == jaxsense.make("map-v0").max_steps
    assert env.num_actions == NOP + 1
