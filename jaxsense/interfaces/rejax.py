"""Tasks and the map MDP as rejax 0.1.3 trains them: `pip install 'jaxsense[rejax]'`."""

import jax
from jax.typing import ArrayLike

from jaxsense.core.types import Key
from jaxsense.interfaces.extras import extra

with extra("rejax"):
    from jaxsense.interfaces import gymnax


class MapEnv(gymnax.MapEnv):
    """Environment for rejax: `gymnax.MapEnv`, but `step` returns five values, as rejax expects.

    rejax 0.1.3 treats a truncated episode as terminated when it learns.
    """

    def step(  # pyright: ignore
        self,
        key: Key,
        state: gymnax.MapEnvState,
        action: ArrayLike,
        params: gymnax.MapEnvParams | None = None,
    ) -> tuple[jax.Array, gymnax.MapEnvState, jax.Array, jax.Array, dict[str, jax.Array]]:
        """Takes one action, and restarts an episode that has ended.

        Args:
          key: random key.
          state: the current state.
          action: `[]` integer, a PoI or N for NOP.
          params: of the environment; the default ones by default.

        Returns:
          Observation, state, reward, whether the episode has ended, and info.
        """
        result = super().step(key, state, action, params)
        observation, state, reward, terminated, truncated, info = result
        return observation, state, reward, terminated | truncated, info
