"""Gymnasium's vector environments for Stable-Baselines3: `pip install 'jaxsense[sb3]'`."""

from collections.abc import Iterable
from typing import Any

import numpy as np

from jaxsense.interfaces.extras import extra

with extra("sb3"):
    from gymnasium.vector import (  # pyright: ignore[reportMissingImports]
        AutoresetMode,
        VectorEnv,
    )
    from stable_baselines3.common.vec_env import VecEnv  # pyright: ignore[reportMissingImports]

Indices = Iterable[int] | int | None
Infos = list[dict[str, bool | np.ndarray]]


class MapVecEnv(VecEnv):
    """Adapts a vector environment of Gymnasium to Stable-Baselines3.

    `MapVecEnv(MapVectorEnv(mdp, modality, num_envs, autoreset_mode="SameStep"))`. The methods are
    Stable-Baselines3's. The environments are one program: attributes and methods apply to all,
    whatever the indices; only `action_masks`, for sb3-contrib, has a row for each.
    """

    def __init__(self, env: VectorEnv):
        """Wraps an environment whose episodes restart in the step in which they end.

        Raises:
          ValueError: if they do not.
        """
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
        """Returns the shared attribute once for each index.

        Args:
          attr_name: its name.
          indices: of environments; all by default.
        """
        return [getattr(self.env, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: object, indices: Indices = None) -> None:
        """Sets the shared attribute.

        Args:
          attr_name: its name.
          value: its value.
          indices: not used.
        """
        setattr(self.env, attr_name, value)

    def env_method(
        self, method_name: str, *args: object, indices: Indices = None, **more: object
    ) -> list:
        """Calls the shared method and returns its result, or its row, once for each index.

        Args:
          method_name: its name.
          *args: its arguments.
          indices: of environments; all by default.
          **more: its arguments by name.
        """
        result = getattr(self.env, method_name)(*args, **more)
        has_rows = method_name == "action_masks"
        return [result[i] if has_rows else result for i in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: type, indices: Indices = None) -> list[bool]:
        """Returns False for each index: no environment has its own wrapper.

        Args:
          wrapper_class: not used.
          indices: of environments; all by default.
        """
        return [False for _ in self._get_indices(indices)]
