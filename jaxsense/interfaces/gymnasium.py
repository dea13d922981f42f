"""The map MDP as a vector environment of Gymnasium: `pip install 'jaxsense[gymnasium]'`."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxsense.core import checks
from jaxsense.core.types import Key
from jaxsense.dqn import map_mdp
from jaxsense.dqn.map_agent import observation
from jaxsense.dqn.map_mdp import MapMdp, MapState, Outcome
from jaxsense.interfaces import common
from jaxsense.interfaces.extras import extra

with extra("gymnasium"):
    from gymnasium import error, spaces  # pyright: ignore[reportMissingImports]
    from gymnasium.vector import (  # pyright: ignore[reportMissingImports]
        AutoresetMode,
        VectorEnv,
    )
    from gymnasium.vector.utils import batch_space  # pyright: ignore[reportMissingImports]


class MapVectorEnv(VectorEnv):
    """Many environments of one agent, stepped side by side by one compiled program.

    An observation is the `[N * 2D]` map, see `dqn.observation`. Action n < N looks at PoI n; action
    N is NOP and terminates the episode. The methods are Gymnasium's.
    """

    def __init__(
        self,
        mdp: MapMdp,
        modality: int,
        num_envs: int,
        starts: MapState | None = None,
        # Quoted: where the site is built without Gymnasium, a stand-in has no `|`.
        autoreset_mode: "AutoresetMode | str" = AutoresetMode.NEXT_STEP,
    ):
        """Makes the environments; `reset` must be called before the first step.

        Args:
          mdp: the MDP, of one agent, see `jaxsense.make_mdp`.
          modality: index of the agent's own sensor.
          num_envs: how many environments, E.
          starts: `[S]` from `interfaces.prepared_starts`, to start each episode from a random one;
            by default each start is new, at the cost of several steps.
          autoreset_mode: when an ended episode restarts, as in `gymnasium.vector`.

        Raises:
          ValueError: if there is no such sensor or mode, or no environment.
        """
        common.check_modality(mdp, modality)
        checks.require_number("num_envs", num_envs)
        self.num_envs = num_envs
        self.metadata = {"autoreset_mode": AutoresetMode(autoreset_mode), "render_modes": []}
        self.single_observation_space, self.single_action_space = common.map_spaces(spaces, mdp)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._states: MapState | None = None
        self._ended = np.zeros(num_envs, bool)
        self._key = jax.random.key(0)
        self._mdp, self._modality, self._starts = mdp, modality, starts

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Starts new episodes.

        Args:
          seed: of all random numbers from here on; by default they continue.
          options: `{"reset_mask": [E] bool}` to restart only some of the environments.

        Returns:
          `[E, N * 2D]` float32 observations and an empty dictionary.

        Raises:
          ValueError: if `reset_mask` does not hold a boolean for each environment.
        """
        super().reset(seed=seed)
        if seed is not None or self._states is None:
            self._key = jax.random.key(int(self.np_random.integers(2**32)))
        given = (options or {}).get("reset_mask")
        mask = np.ones(self.num_envs, bool) if given is None else np.asarray(given)
        if mask.shape != (self.num_envs,) or mask.dtype != bool:
            raise ValueError(f"reset_mask = {given!r}: must hold {self.num_envs} booleans")
        if given is None:
            self._states = None
        return self._restarted(mask), {}

    def step(
        self, actions: Any
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Takes one action in each environment.

        Args:
          actions: `[E]` integers.

        Returns:
          `[E, N * 2D]` float32 observations, `[E]` float64 rewards, `[E]` bool terminations and
          truncations, and, in mode `SAME_STEP`, the last observation of each ended episode as
          `final_obs`.

        Raises:
          ResetNeeded: before the first reset; in mode `DISABLED`, if an episode has ended.
          ValueError: if there is no such action.
        """
        actions = np.asarray(actions)
        self._check_step(actions)
        mode, ended = self.metadata["autoreset_mode"], self._ended
        self._key, observations, self._states, outcome = _step(
            self._key, self._mdp, self._states, actions.astype(np.int32), self._modality
        )
        observations = np.array(observations)
        rewards = np.array(outcome.reward, np.float64)
        terminations, truncations = np.array(outcome.terminated), np.array(outcome.truncated)
        infos = {}
        if mode is AutoresetMode.NEXT_STEP and ended.any():
            observations = self._restarted(ended)
            rewards[ended] = 0.0
            terminations &= ~ended
            truncations &= ~ended
        self._ended = terminations | truncations
        if mode is AutoresetMode.SAME_STEP and self._ended.any():
            infos = _final(observations, self._ended)
            observations = self._restarted(self._ended)
        return observations, rewards, terminations, truncations, infos

    def _check_step(self, actions: np.ndarray) -> None:
        """Raises what `step` raises."""
        if self._states is None:
            raise error.ResetNeeded("step before reset")
        if self.metadata["autoreset_mode"] is AutoresetMode.DISABLED and self._ended.any():
            raise error.ResetNeeded(f"environments {np.flatnonzero(self._ended)} have ended")
        is_whole = np.issubdtype(actions.dtype, np.integer)
        if not (is_whole and self.action_space.contains(actions)):
            raise ValueError(f"actions = {actions!r}: must be in {self.action_space}")

    def _restarted(self, mask: np.ndarray) -> np.ndarray:
        """Observations after new starts where the mask is True."""
        self._key, observations, self._states = _start(
            self._key, self._mdp, self._starts, self._states, mask
        )
        self._ended = self._ended & ~mask
        return np.array(observations)


def _final(observations: np.ndarray, ended: np.ndarray) -> dict[str, Any]:
    """Gymnasium's information about `[E]` bool `ended` episodes."""
    final = np.full(len(ended), None, object)
    for i in np.flatnonzero(ended):
        final[i] = observations[i]
    return {"final_obs": final, "_final_obs": ended, "final_info": {}, "_final_info": ended}


# Static, so that only one sensor is compiled.
@functools.partial(jax.jit, static_argnames="modality")
def _step(
    key: Key, mdp: MapMdp, states: MapState, actions: jax.Array, modality: int
) -> tuple[Key, jax.Array, MapState, Outcome]:
    """Next key, `[E, N * 2D]` observations, `[E]` states and `[E]` outcomes."""
    next_key, key = jax.random.split(key)
    step = jax.vmap(lambda k, s, a: map_mdp.step(k, mdp, s, a, modality))
    states, outcome = step(jax.random.split(key, len(actions)), states, actions)
    return next_key, jax.vmap(observation)(states.belief), states, outcome


@jax.jit
def _start(
    key: Key,
    mdp: MapMdp,
    starts: MapState | None,
    states: MapState | None,
    mask: jax.Array,
) -> tuple[Key, jax.Array, MapState]:
    """Next key, observations and states, with new starts where `mask` is True or all are new."""
    next_key, key = jax.random.split(key)
    keys = jax.random.split(key, len(mask))
    fresh = jax.vmap(lambda key: common.start(key, mdp, starts))(keys)

    def pick(new: jax.Array, old: jax.Array) -> jax.Array:
        return jnp.where(mask.reshape(-1, *[1] * (new.ndim - 1)), new, old)

    begun = fresh if states is None else jax.tree.map(pick, fresh, states)
    return next_key, jax.vmap(observation)(begun.belief), begun
