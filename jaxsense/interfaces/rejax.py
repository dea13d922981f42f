"""Tasks and the map MDP as rejax 0.1.3 trains them: `pip install 'jaxsense[rejax]'`."""

import jax
from jax.typing import ArrayLike

from jaxsense.core.types import Key
from jaxsense.interfaces.common import extra

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
        """Takes one action, and restarts an episode that has ended."""
        *found, terminated, truncated, info = super().step(key, state, action, params)
        return *found, terminated | truncated, info
