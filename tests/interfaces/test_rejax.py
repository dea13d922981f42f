"""rejax 0.1.3, unmodified, trains on the form of five values."""

import jax
import numpy as np
import pytest
import small

pytest.importorskip("gymnax", reason="needs the extra jaxsense[gymnax]")

from jaxsense.dqn import observation
from jaxsense.interfaces import gymnax
from jaxsense.interfaces.rejax import MapEnv


@pytest.mark.slow
def test_a_step_is_that_of_gymnax_with_five_values():
    ours, theirs = MapEnv(small.small_mdp(), 0), gymnax.MapEnv(small.small_mdp(), 0)
    params = ours.default_params.replace(max_steps_in_episode=2)
    obs, state = ours.reset(jax.random.key(0), params)
    np.testing.assert_array_equal(obs, theirs.reset(jax.random.key(0), params)[0])
    endings = []
    for action in (0, 3, 1, 1):
        key = jax.random.key(action)
        expected = theirs.step(key, state, action, params)
        obs, state, reward, done, _ = ours.step(key, state, action, params)
        jax.tree.map(np.testing.assert_array_equal, (obs, state, reward), expected[:3])
        endings.append(bool(done))
    assert endings == [False, True, False, True]


def test_its_dqn_reaches_95_percent_of_the_optimal_return():
    rejax = pytest.importorskip("rejax", reason="rejax: needs the extra jaxsense[rejax]")
    env = MapEnv(small.small_mdp(), 0)
    algorithm = rejax.DQN.create(
        env=env,
        env_params=env.prepared_params(jax.random.key(5), 512),
        num_envs=64,
        total_timesteps=16384,
        eval_freq=16384,
        skip_initial_evaluation=True,
        num_epochs=8,
        batch_size=128,
        buffer_size=2048,
        fill_buffer=512,
        target_update_freq=1024,
        polyak=0.0,
        learning_rate=2e-3,
        gamma=0.5,
        ddqn=False,
        exploration_fraction=0.4,
    )
    state, (lengths, _) = jax.jit(algorithm.train)(jax.random.key(6))
    assert lengths.max() <= small.CONFIG.mdp.max_steps
    act = algorithm.make_act(state)
    reached = small.returns(lambda key, known: act(observation(known.belief), key)).mean()
    assert reached >= 0.95 * small.optimal_return()
