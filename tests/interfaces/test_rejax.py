"""rejax 0.1.3, unmodified, trains; `test_parity` has the steps."""

import jax
import pytest
import small

pytest.importorskip("rejax", reason="rejax: needs the extra jaxsense[rejax]")

import rejax

from jaxsense.interfaces.rejax import MapEnv


@pytest.mark.slow
def test_its_dqn_learns():
    env = MapEnv(small.small_mdp(), 0)
    algorithm = rejax.DQN.create(
        env=env,
        env_params=env.prepared_params(jax.random.key(5), 512),
        num_envs=64,
        total_timesteps=16384,
        eval_freq=16384,
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
    _, (lengths, returns) = jax.jit(algorithm.train)(jax.random.key(6))
    assert lengths.max() <= small.small_mdp().config.max_steps
    before, after = returns.mean(axis=1)
    assert after > max(before, 0.0)
