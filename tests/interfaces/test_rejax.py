"""rejax 0.1.3, unmodified, trains; `test_parity` has the steps."""

import jax
import pytest
import small

pytest.importorskip("rejax", reason="rejax: needs the extra jaxsense[rejax]")

import rejax

from jaxsense.dqn import observation
from jaxsense.interfaces.rejax import MapEnv


def test_its_dqn_reaches_95_percent_of_the_optimal_return():
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
