"""Tasks and the map MDP in Gymnasium: `pip install 'jaxsense[gymnasium]'`.

The import registers every task as `jaxsense/NAME`, for `gymnasium.make` and `make_vec`.
"""

from typing import Any, SupportsInt

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree
from numpy.typing import ArrayLike

from jaxsense.core import checks
from jaxsense.core.types import Key
from jaxsense.dqn.map_mdp import MapMdp
from jaxsense.interfaces import common
from jaxsense.interfaces.extras import extra
from jaxsense.show.task_plots import frame, frames
from jaxsense.tasks import Environment, Task, TimeStep, registered
from jaxsense.tasks.registry import as_task

with extra("gymnasium"):
    from gymnasium import (  # pyright: ignore[reportMissingImports]
        Env,
        error,
        register,
        registry,
        spaces,
    )
    from gymnasium.vector import (  # pyright: ignore[reportMissingImports]
        AutoresetMode,
        VectorEnv,
    )
    from gymnasium.vector.utils import batch_space  # pyright: ignore[reportMissingImports]


class TaskEnv(Env):
    """A task as an environment: `gymnasium.make("jaxsense/noisy-v0")`.

    One policy chooses, for a team for the robot whose turn it is. Action n < N looks at PoI n;
    action N is NOP. `action_mask` in the infos, `[N + 1]` int8, is 1 for the actions that exist.
    The methods are Gymnasium's.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 2}  # noqa: RUF012, as in `Env`

    def __init__(self, task: Task | str, agent: str | None = None, render_mode: str | None = None):
        """Makes the environment; `reset` must be called before the first step.

        Args:
          task: from `jaxsense.make`, or its name.
          agent: whose sensor looks, see `jaxsense.make`; only with a name.
          render_mode: `rgb_array`, so that `render` draws the map; None to draw nothing.

        Raises:
          ConfigError: if there is no such task or agent.
          ValueError: if there is no such mode.
        """
        self.render_mode = common.checked_mode(render_mode, self.metadata["render_modes"])
        self.task = as_task(task, agent)
        common.enter_process()
        self.observation_space, self.action_space = common.environment_spaces(spaces, self.task)
        self._key: Key | None = None
        self._state: PyTree = None
        self._mask = np.ones(self.task.num_actions, np.int8)
        self._actions: list[int] = []
        self._has_ended = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, object] | None = None
    ) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Starts an episode.

        Args:
          seed: of all random numbers from here on; by default they continue.
          options: ignored.

        Returns:
          `[S]` float32 observation, and infos.
        """
        del options
        common.require_own_process()
        super().reset(seed=seed)
        if seed is not None or self._key is None:
            self._key = _key(self)
        self._key, observation, self._state, mask = _begin(self._key, self.task)
        self._actions, self._has_ended = [], False
        return np.array(observation), self._info(mask)

    def step(
        self, action: SupportsInt
    ) -> tuple[np.ndarray, float, bool, bool, dict[str, np.ndarray]]:
        """Takes an action.

        Args:
          action: an integer.

        Returns:
          `[S]` float32 observation, reward, whether the episode is terminated, whether it is
          truncated, and infos.

        Raises:
          ResetNeeded: before the first reset, or if the episode has ended.
          ValueError: if there is no such action.
        """
        if self._state is None or self._has_ended:
            raise error.ResetNeeded("step before reset, or after the end of an episode")
        if not self.action_space.contains(np.asarray(action)):
            raise ValueError(f"action = {action!r}: must be in {self.action_space}")
        self._key, self._state, found, mask = _advance(
            self._key, self.task, self._state, np.int32(action)
        )
        self._actions.append(int(action))
        terminated, truncated = bool(found.terminated), bool(found.truncated)
        self._has_ended = terminated or truncated
        observation, reward = np.array(found.observation), float(found.reward)
        return observation, reward, terminated, truncated, self._info(mask)

    def action_masks(self) -> np.ndarray:
        """`[N + 1]` bool, the actions that exist, as sb3-contrib asks for them."""
        return self._mask.astype(bool)

    def render(self) -> np.ndarray | None:
        """`[H, W, 3]` uint8 picture of the map.

        Returns:
          None without a `render_mode`.

        Raises:
          ResetNeeded: before the first reset.
        """
        if self.render_mode is None:
            return None
        if self._state is None:
            raise error.ResetNeeded("render before reset")
        return frame(self.task, self._state, self._actions)

    def _info(self, mask: jax.Array) -> dict[str, np.ndarray]:
        self._mask = np.asarray(mask, np.int8)
        return {"action_mask": self._mask.copy()}


class MapVectorEnv(VectorEnv):
    """A vector environment, stepped by one compiled program.

    It plays a task, see `TaskEnv`, or the map MDP of one agent, whose observations are the
    `[N * 2D]` map, see `dqn.observation`. Action n < N looks at PoI n; action N is NOP and
    terminates the episode. `action_mask` in the infos, `[E, N + 1]` int8, is 1 for the actions that
    exist. The methods are Gymnasium's.
    """

    def __init__(
        self,
        mdp: MapMdp | Environment,
        modality: int | None = None,
        num_envs: int = 1,
        starts: PyTree = None,
        # Quoted: where the site is built without Gymnasium, a stand-in has no `|`.
        autoreset_mode: "AutoresetMode | str" = AutoresetMode.NEXT_STEP,
        render_mode: str | None = None,
    ):
        """Makes the environments; `reset` must be called before the first step.

        Args:
          mdp: a task from `jaxsense.make`, or the MDP of one agent, see `jaxsense.make_mdp`.
          modality: index of the agent's own sensor; only with an MDP.
          num_envs: how many environments, E.
          starts: from `interfaces.prepared_starts`, to start each episode from a random one; by
            default each start is new, at the cost of several steps.
          autoreset_mode: when an ended episode restarts, as in `gymnasium.vector`.
          render_mode: see `TaskEnv`; only with a task.

        Raises:
          ValueError: if there is no such sensor or mode, or no environment.
        """
        played = common.environment(mdp, modality)
        common.enter_process()
        checks.require_number("num_envs", num_envs)
        self.num_envs = num_envs
        self._task: Task | None = played if isinstance(played, Task) else None
        self.metadata = {**TaskEnv.metadata} if self._task else {"render_modes": []}
        self.metadata["autoreset_mode"] = common.member(
            "autoreset_mode", AutoresetMode, autoreset_mode
        )
        self.render_mode = common.checked_mode(render_mode, self.metadata["render_modes"])
        single = common.environment_spaces(spaces, played)
        self.single_observation_space, self.single_action_space = single
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._states: PyTree = None
        self._mask = np.ones((num_envs, played.num_actions), np.int8)
        self._ended = np.zeros(num_envs, bool)
        self._actions: list[list[int]] = [[] for _ in range(num_envs)]  # to draw
        self._key = jax.random.key(0)
        self._played, self._starts = played, starts

    def reset(
        self, *, seed: int | None = None, options: dict[str, object] | None = None
    ) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Starts new episodes.

        Args:
          seed: of all random numbers from here on; by default they continue.
          options: `{"reset_mask": [E] bool}` to restart only some of the environments.

        Returns:
          `[E, S]` float32 observations, and infos.

        Raises:
          ValueError: if `reset_mask` does not hold a boolean for each environment.
        """
        common.require_own_process()
        super().reset(seed=seed)
        if seed is not None or self._states is None:
            self._key = _key(self)
        given = (options or {}).get("reset_mask")
        mask = np.ones(self.num_envs, bool) if given is None else np.asarray(given)
        if mask.shape != (self.num_envs,) or mask.dtype != bool:
            raise ValueError(f"reset_mask = {given!r}: must hold {self.num_envs} booleans")
        if given is None:
            self._states = None
        return self._restarted(mask), self._infos()

    def step(
        self, actions: ArrayLike
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Takes one action in each environment.

        Args:
          actions: `[E]` integers.

        Returns:
          `[E, S]` float32 observations, `[E]` float64 rewards, `[E]` bool terminations and
          truncations, and, in mode `SAME_STEP`, the last observation of each ended episode as
          `final_obs`.

        Raises:
          ResetNeeded: before the first reset; in mode `DISABLED`, if an episode has ended.
          ValueError: if there is no such action.
        """
        actions = np.asarray(actions)
        self._check_step(actions)
        mode, ended = self.metadata["autoreset_mode"], self._ended
        self._key, self._states, outcome, mask = _step(
            self._key, self._played, self._states, actions.astype(np.int32)
        )
        self._mask = np.array(mask, np.int8)
        if self.render_mode is not None:
            for before, action in zip(self._actions, actions, strict=True):
                before.append(int(action))
        observations = np.array(outcome.observation)
        rewards = np.array(outcome.reward, np.float64)
        terminations, truncations = np.array(outcome.terminated), np.array(outcome.truncated)
        final = {}
        if mode is AutoresetMode.NEXT_STEP and ended.any():
            observations = self._restarted(ended)
            rewards[ended] = 0.0
            terminations &= ~ended
            truncations &= ~ended
        self._ended = terminations | truncations
        if mode is AutoresetMode.SAME_STEP and self._ended.any():
            final = _final(observations, self._mask, self._ended)
            observations = self._restarted(self._ended)
        return observations, rewards, terminations, truncations, {**self._infos(), **final}

    def action_masks(self) -> np.ndarray:
        """`[E, N + 1]` bool, the actions that exist, see `TaskEnv.action_masks`."""
        return self._mask.astype(bool)

    def render(self) -> tuple[np.ndarray, ...] | None:
        """A picture of each map, see `TaskEnv.render`."""
        if self._task is None or self.render_mode is None:
            return None
        if self._states is None:
            raise error.ResetNeeded("render before reset")
        return frames(self._task, self._states, self._actions)

    def _check_step(self, actions: np.ndarray) -> None:
        """Raises what `step` raises."""
        if self._states is None:
            raise error.ResetNeeded("step before reset")
        if self.metadata["autoreset_mode"] is AutoresetMode.DISABLED and self._ended.any():
            raise error.ResetNeeded(f"environments {np.flatnonzero(self._ended)} have ended")
        is_whole = np.issubdtype(actions.dtype, np.integer)
        if not (is_whole and self.action_space.contains(actions)):
            raise ValueError(f"actions = {actions!r}: must be integers in {self.action_space}")

    def _restarted(self, mask: np.ndarray) -> np.ndarray:
        """Observations after new starts where the mask is True."""
        self._key, observations, self._states, found = _start(
            self._key, self._played, self._starts, self._states, mask
        )
        self._ended = self._ended & ~mask
        for i in np.flatnonzero(mask):
            self._actions[i] = []
        self._mask = np.array(found, np.int8)
        return np.array(observations)

    def _infos(self) -> dict[str, np.ndarray]:
        """The actions that exist, and that all environments tell them."""
        return {"action_mask": self._mask.copy(), "_action_mask": np.ones(self.num_envs, bool)}


def make_vec(
    task: Task | str,
    num_envs: int,
    agent: str | None = None,
    starts: int | None = None,
    autoreset_mode: "AutoresetMode | str" = AutoresetMode.NEXT_STEP,
    render_mode: str | None = None,
) -> MapVectorEnv:
    """Makes a vector environment: `gymnasium.make_vec("jaxsense/noisy-v0", num_envs=64)`.

    Args:
      task: from `jaxsense.make`, or its name.
      num_envs: how many environments.
      agent: whose sensor looks, see `jaxsense.make`; only with a name.
      starts: number of prepared starts, to start each episode from a random one; by default each
        start is new, at the cost of several steps.
      autoreset_mode: see `MapVectorEnv`.
      render_mode: see `TaskEnv`.

    Raises:
      ConfigError: if there is no such task or agent.
      ValueError: if there is no such mode, no environment or no start.
    """
    found = as_task(task, agent)
    prepared = None if starts is None else common.prepared_starts(jax.random.key(0), found, starts)
    return MapVectorEnv(found, None, num_envs, prepared, autoreset_mode, render_mode)


def _key(env: "Env | VectorEnv") -> Key:
    """A key from the random numbers of an environment."""
    return jax.random.key(int(env.np_random.integers(2**32)))


def _final(
    observations: np.ndarray, mask: np.ndarray, ended: np.ndarray
) -> dict[str, np.ndarray | dict[str, np.ndarray]]:
    """Gymnasium's information about `[E]` bool `ended` episodes."""
    final = np.full(len(ended), None, object)
    for i in np.flatnonzero(ended):
        final[i] = observations[i]
    info = {"action_mask": np.where(ended[:, None], mask, 0), "_action_mask": ended}
    return {"final_obs": final, "_final_obs": ended, "final_info": info, "_final_info": ended}


@jax.jit
def _begin(key: Key, played: Environment) -> tuple[Key, jax.Array, PyTree, jax.Array]:
    """Next key, `[S]` observation, state and `[A]` actions that exist."""
    next_key, key = jax.random.split(key)
    observation, state = played.reset(key)
    return next_key, observation, state, played.action_mask(state)


@jax.jit
def _advance(
    key: Key, played: Environment, state: PyTree, action: jax.Array
) -> tuple[Key, PyTree, TimeStep, jax.Array]:
    """Next key, state, what the agent sees of it, and `[A]` actions that exist."""
    next_key, key = jax.random.split(key)
    after, found = played.step(key, state, action)
    return next_key, after, found, played.action_mask(after)


@jax.jit
def _step(
    key: Key, played: Environment, states: PyTree, actions: jax.Array
) -> tuple[Key, PyTree, TimeStep, jax.Array]:
    """Next key, `[E]` states, `[E]` time steps and `[E, A]` actions that exist."""
    next_key, key = jax.random.split(key)
    step = jax.vmap(played.step)
    states, outcome = step(jax.random.split(key, len(actions)), states, actions)
    return next_key, states, outcome, jax.vmap(played.action_mask)(states)


@jax.jit
def _start(
    key: Key, played: Environment, starts: PyTree, states: PyTree, mask: jax.Array
) -> tuple[Key, jax.Array, PyTree, jax.Array]:
    """Next key, observations, states and actions that exist.

    Starts are new where `mask` is True, or all of them if there are no states yet.
    """
    next_key, key = jax.random.split(key)
    keys = jax.random.split(key, len(mask))
    _, fresh = jax.vmap(lambda key: common.start(key, played, starts))(keys)

    def pick(new: jax.Array, old: jax.Array) -> jax.Array:
        return jnp.where(mask.reshape(-1, *[1] * (new.ndim - 1)), new, old)

    begun = fresh if states is None else jax.tree.map(pick, fresh, states)
    observations = jax.vmap(played.observe)(begun)
    return next_key, observations, begun, jax.vmap(played.action_mask)(begun)


for _name in registered():
    if f"jaxsense/{_name}" not in registry:
        register(
            f"jaxsense/{_name}",
            entry_point=f"{__name__}:TaskEnv",
            vector_entry_point=f"{__name__}:make_vec",
            kwargs={"task": _name},
        )
