"""Stable-Baselines3 learns on the vector environment."""

import jax
import numpy as np
import pytest
import small

pytest.importorskip("stable_baselines3", reason="stable_baselines3: needs the extra jaxsense[sb3]")

import stable_baselines3 as sb3
import torch
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

from jaxsense import make
from jaxsense.interfaces import prepared_starts
from jaxsense.interfaces.gymnasium import MapVectorEnv
from jaxsense.interfaces.stable_baselines3 import MapVecEnv

NOP = 3


@pytest.fixture(scope="module")
def env():
    mdp = small.small_mdp()
    starts = prepared_starts(jax.random.key(0), mdp, 64)
    return MapVecEnv(MapVectorEnv(mdp, 0, 4, starts, "SameStep"))


def test_its_dqn_learns(env):
    torch.set_num_threads(1)  # faster than two for networks of this size
    model = sb3.DQN(
        "MlpPolicy",
        VecMonitor(env),
        learning_starts=64,
        batch_size=64,
        train_freq=1,
        gradient_steps=2,
        learning_rate=5e-3,
        gamma=0.5,
        target_update_interval=64,
        exploration_fraction=0.5,
        seed=0,
    )
    env.seed(1)
    before, _ = evaluate_policy(model, env, n_eval_episodes=40, warn=False)
    model.learn(1600)
    env.seed(1)
    after, _ = evaluate_policy(model, env, n_eval_episodes=40, warn=False)
    assert len(model.ep_info_buffer) > 0
    assert after > max(before, 0.0)


def test_its_ppo_takes_it_normalised(env):
    model = sb3.PPO("MlpPolicy", VecNormalize(env), n_steps=16, batch_size=32, n_epochs=1)
    model.learn(128)
    assert model.num_timesteps == 128


def test_ends_are_told_as_stable_baselines3_has_them(env):
    env.seed(5)
    first = env.reset()
    observations, rewards, dones, infos = env.step(np.array([NOP, 0, 1, 2]))
    assert (rewards.dtype, list(dones)) == (np.float32, [True, False, False, False])
    np.testing.assert_array_equal(infos[0]["terminal_observation"], first[0])
    assert (observations[0] != first[0]).any()
    np.testing.assert_array_equal(infos[1].pop("action_mask"), [1, 1, 1, 1])
    assert infos[1] == {"TimeLimit.truncated": False}
    for _ in range(small.CONFIG.mdp.max_steps - 1):
        _, _, dones, infos = env.step(np.zeros(4, int))
    assert dones[1]
    assert infos[1]["TimeLimit.truncated"]
    env.seed(5)
    np.testing.assert_array_equal(env.reset(), first)


def test_attributes_are_those_of_the_whole():
    env = MapVecEnv(MapVectorEnv(small.small_mdp(), 0, 2, autoreset_mode="SameStep"))
    assert env.get_attr("num_envs") == [2, 2]
    assert env.get_attr("num_envs", 1) == [2]
    env.set_attr("render_mode", None)
    assert not any(env.env_is_wrapped(VecMonitor))
    assert env.env_method("close") == [None, None]
    assert env.get_attr("closed", [0]) == [True]


def test_masks_are_those_of_each_environment():
    """As `sb3_contrib.common.maskable.utils.get_action_masks` asks for them."""
    env = VecMonitor(
        MapVecEnv(MapVectorEnv(make("team-v0"), num_envs=8, autoreset_mode="SameStep"))
    )
    env.seed(0)
    env.reset()
    masks = np.stack(env.env_method("action_masks"))
    assert (masks.shape, masks.dtype) == ((8, 9), bool)
    assert masks[:, -1].all()
    assert len(np.unique(masks, axis=0)) > 1  # the numbers of PoIs differ
    np.testing.assert_array_equal(env.env_method("action_masks", indices=[2, 5]), masks[[2, 5]])
    _, _, _, infos = env.step(np.full(8, 8))
    told = np.stack([info["action_mask"] for info in infos])
    np.testing.assert_array_equal(told, env.env_method("action_masks"))


def test_only_episodes_that_start_again_in_the_same_step_are_taken():
    env = MapVectorEnv(small.small_mdp(), 0, 2)
    with pytest.raises(ValueError, match=r"autoreset_mode = .*must be AutoresetMode\.SAME_STEP"):
        MapVecEnv(env)
