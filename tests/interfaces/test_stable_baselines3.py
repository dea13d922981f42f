"""Stable-Baselines3: cuts, attributes and masks; `test_parity` has the steps."""

import numpy as np
import pytest

pytest.importorskip("stable_baselines3", reason="stable_baselines3: needs the extra jaxsense[sb3]")

from stable_baselines3.common.vec_env import VecMonitor

import jaxsense
from jaxsense.interfaces.gymnasium import make_vec
from jaxsense.interfaces.stable_baselines3 import MapVecEnv


@pytest.fixture(scope="module")
def env():
    return MapVecEnv(make_vec("map-v0", 4, starts=64, autoreset_mode="SameStep"))


def test_a_cut_is_told_as_stable_baselines3_has_it(env):
    env.seed(5)
    first = env.reset()
    for _ in range(jaxsense.make("map-v0").max_steps):
        _, rewards, dones, infos = env.step(np.zeros(4, int))
    assert rewards.dtype == np.float32
    assert dones.all()
    assert all(info["TimeLimit.truncated"] for info in infos)
    env.seed(5)
    np.testing.assert_array_equal(env.reset(), first)


def test_attributes_are_those_of_the_whole_and_masks_those_of_each():
    """As `sb3_contrib.common.maskable.utils.get_action_masks` asks for them."""
    env = VecMonitor(MapVecEnv(make_vec("team-v0", 8, autoreset_mode="SameStep")))
    assert env.get_attr("num_envs", [0, 1]) == [8, 8]
    env.set_attr("render_mode", None)
    assert not any(env.env_is_wrapped(VecMonitor))
    env.seed(0)
    env.reset()
    masks = np.stack(env.env_method("action_masks"))
    assert (masks.shape, masks.dtype) == ((8, 9), bool)
    assert len(np.unique(masks, axis=0)) > 1  # the numbers of PoIs differ
    np.testing.assert_array_equal(env.env_method("action_masks", indices=[2, 5]), masks[[2, 5]])
    env.env_method("close", indices=0)
    assert env.get_attr("closed", [0]) == [True]
