"""Gymnasium's vector environments for Stable-Baselines3: `pip install 'jaxsense[sb3]'`."""

from collections.abc import Iterable
from typing import Any

import numpy as np

from jaxsense.interfaces.common import extra

with extra("sb3"):
    from gymnasium.vector import AutoresetMode, VectorEnv  # pyright: ignore
    from stable_baselines3.common.vec_env import VecEnv  # pyright: ignore[reportMissingImports]

Indices = Iterable[int] | int | None
Infos = list[dict[str, bool | np.ndarray]]


class MapVecEnv(VecEnv):
    """Adapts a vector environment of Gymnasium to Stable-Baselines3.

    `MapVecEnv(MapVectorEnv(mdp, num_envs=64, autoreset_mode="SameStep"))`. The methods are
    Stable-Baselines3's. The environments are one program: attributes and methods apply to all,
    whatever the indices; only `action_masks`, for sb3-contrib, has a row for each.
    """

    def __init__(self, env: VectorEnv):
        """Wraps an environment whose episodes restart in the step in which they end."""
        mode = env.metadata.get("autoreset_mode")
        if mode is not AutoresetMode.SAME_STEP:
            raise ValueError(f"autoreset_mode = {mode}: must be AutoresetMode.SAME_STEP")
        self.env = env
        self._actions: np.ndarray | None = None
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)

    def reset(self) -> np.ndarray:
        """Starts new episodes, with the seed passed to `seed`."""
        observations, _ = self.env.reset(seed=self._seeds[0])
        self._reset_seeds()
        self._reset_options()
        return observations

    def step_async(self, actions: np.ndarray) -> None:
        """Stores the actions."""
        self._actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, Infos]:
        """Takes the stored actions."""
        observations, rewards, terminations, truncations, infos = self.env.step(self._actions)
        dones = terminations | truncations
        cuts = truncations & ~terminations
        of_each: Infos = [{"TimeLimit.truncated": bool(truncated)} for truncated in cuts]
        for info, mask in zip(of_each, infos.get("action_mask", ()), strict=False):
            info["action_mask"] = mask
        for i in np.flatnonzero(dones):
            of_each[i]["terminal_observation"] = infos["final_obs"][i]
        return observations, rewards.astype(np.float32), dones, of_each

    def close(self) -> None:
        """Closes the environment."""
        self.env.close()

    def get_attr(self, attr_name: str, indices: Indices = None) -> list[Any]:
        """The shared attribute, once for each index."""
        return [getattr(self.env, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: object, indices: Indices = None) -> None:
        """Sets the shared attribute."""
        del indices
        setattr(self.env, attr_name, value)

    def env_method(
        self, method_name: str, *args: object, indices: Indices = None, **more: object
    ) -> list:
        """Result of the shared method, or its row, once for each index."""
        result = getattr(self.env, method_name)(*args, **more)
        has_rows = method_name == "action_masks"
        return [result[i] if has_rows else result for i in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: type, indices: Indices = None) -> list[bool]:
        """False for each index: no environment has its own wrapper."""
        del wrapper_class
        return [False for _ in self._get_indices(indices)]
