"""The gymnax form: the MDP's own functions behind gymnax 1.x."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import small

pytest.importorskip("gymnax", reason="needs the extra jaxsense[gymnax]")

from gymnax.wrappers import purerl
from gymnax.wrappers.gym import GymnaxToGymWrapper

from jaxsense import make
from jaxsense.dqn import map_mdp, observation
from jaxsense.interfaces.gymnax import MapEnv
from jaxsense.looks import make_mdp
from jaxsense.models import init

LIDAR = 1


@pytest.fixture(scope="module")
def env():
    return MapEnv(small.small_mdp(), LIDAR)


def assert_trees_equal(actual, expected):
    jax.tree.map(np.testing.assert_array_equal, actual, expected)


def test_every_step_equals_the_mdps(env):
    params = env.default_params
    obs, state = env.reset(jax.random.key(0), params)
    expected = jax.jit(lambda key: map_mdp.reset(key, small.small_mdp()))(jax.random.key(0))
    mdp_step = jax.jit(lambda k, s, a: map_mdp.step(k, small.small_mdp(), s, a, LIDAR))
    for i, action in enumerate([0, 1, 0, 2, 3]):
        np.testing.assert_allclose(obs, observation(expected.belief), rtol=1e-6)
        assert_trees_equal(state.map.seen, expected.seen)
        key = jax.random.key(10 + i)
        obs, state, reward, terminated, truncated, info = env.step(key, state, action, params)
        expected, outcome = mdp_step(jax.random.split(key)[0], expected, jnp.int32(action))
        np.testing.assert_allclose(reward, outcome.reward, rtol=1e-5)
        assert (terminated, truncated) == (outcome.terminated, outcome.truncated)
        final = observation(expected.belief)
        np.testing.assert_allclose(info["final_observation"], final, rtol=1e-6)
        assert info["discount"] == 1.0 - outcome.terminated
    assert terminated
    start, _ = env.reset(jax.random.split(key)[1], params)
    np.testing.assert_allclose(obs, start, rtol=1e-6)
    assert not state.terminated
    assert state.time == 0


def test_params_say_when_an_episode_is_truncated(env):
    params = env.default_params.replace(max_steps_in_episode=2)
    _, state = env.reset(jax.random.key(0), params)
    for expected in (False, True, False, True):
        _, state, _, terminated, truncated, _ = env.step(jax.random.key(1), state, 0, params)
        assert (terminated, truncated) == (False, expected)
    _, state, _, _, _, _ = env.step(jax.random.key(1), state, 0, params)
    terminated, truncated = env.step(jax.random.key(1), state, env.num_actions - 1, params)[3:5]
    assert (terminated, truncated) == (True, False)
    assert env.default_params.max_steps_in_episode == small.CONFIG.mdp.max_steps


def test_prepared_starts_are_drawn_and_no_others(env):
    params = env.prepared_params(jax.random.key(2), 5)
    keys = jax.random.split(jax.random.key(3), 100)
    drawn, _ = jax.vmap(env.reset, (0, None))(keys, params)
    starts = jax.vmap(observation)(params.starts.belief)
    distances = np.abs(np.asarray(drawn)[:, None] - np.asarray(starts)[None]).max(axis=2)
    assert (distances.min(axis=1) == 0).all()
    assert (distances.min(axis=0) == 0).all()


def test_a_batch_equals_single_environments(env):
    params = env.prepared_params(jax.random.key(2), 16)
    keys = jax.random.split(jax.random.key(3), 4)
    actions = jnp.array([0, 1, 2, 3])
    _, states = jax.vmap(env.reset, (0, None))(keys, params)
    together = jax.vmap(env.step, (0, 0, 0, None))(keys, states, actions, params)
    for i in range(4):
        state = jax.tree.map(lambda x: x[i], states)  # noqa: B023
        alone = env.step(keys[i], state, actions[i], params)
        jax.tree.map(
            lambda x, y: np.testing.assert_allclose(x[i], y, atol=1e-5),  # noqa: B023
            together,
            alone,
        )


def test_spaces_tell_what_is_given(env):
    obs, state = env.reset(jax.random.key(0))
    space = env.observation_space(env.default_params)
    assert (space.shape, space.dtype) == (obs.shape, obs.dtype)
    assert space.contains(obs)
    assert env.action_space(env.default_params).n == env.num_actions == 4
    assert state.time == 0


def test_wrappers_of_gymnax_take_it(env):
    params = env.prepared_params(jax.random.key(2), 4)
    logged = purerl.LogWrapper(env)
    _, state = logged.reset(jax.random.key(0), params)
    *_, info = logged.step(jax.random.key(1), state, env.num_actions - 1, params)
    assert info["returned_episode_lengths"] == 1
    single = GymnaxToGymWrapper(env, params)
    obs, _ = single.reset(seed=0)
    assert single.observation_space.contains(np.asarray(obs))
    assert single.step(single.action_space.n - 1)[2]


def test_its_name_is_that_of_the_task(env):
    assert MapEnv(make("many-v0")).name == "many-v0"
    assert env.name == "jaxsense-Map"


def test_live_observations_trace():
    def play(key):
        env = MapEnv(make_mdp(small.CONFIG, init(key, small.CONFIG)).map, 0)
        _, state = env.reset(key, env.default_params)
        return env.step(key, state, 0, env.default_params)

    obs, _, reward, *_ = jax.eval_shape(play, jax.random.key(0))
    assert (obs.shape, reward.shape) == ((12,), ())


@pytest.mark.parametrize("modality", [-1, 2])
def test_a_sensor_that_is_not_there_is_named(modality):
    with pytest.raises(ValueError, match=f"modality = {modality}: must be a whole number"):
        MapEnv(small.small_mdp(), modality)


@pytest.mark.parametrize("action", [1.7, jnp.float32(1), np.array([0, 1])])
def test_an_action_that_is_no_integer_is_refused(env, action):
    _, state = env.reset(jax.random.key(0))
    with pytest.raises(ValueError, match="action"):
        env.step(jax.random.key(1), state, action)


@pytest.mark.parametrize("action", [2, np.int64(2), np.uint8(2), jnp.int32(2)])
def test_integers_of_all_libraries_are_the_same_action(env, action):
    _, state = env.reset(jax.random.key(0))
    after = env.step_env(jax.random.key(1), state, action, env.default_params)[1]
    assert after.map.seen[2, LIDAR]
