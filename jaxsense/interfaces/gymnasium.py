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
from jaxsense.dqn.mdp import Mdp
from jaxsense.interfaces import common
from jaxsense.tasks import Environment, Task, TimeStep, registered
from jaxsense.tasks.registry import as_task

with common.extra("gymnasium"):
    from gymnasium import Env, error, register, registry, spaces  # pyright: ignore
    from gymnasium.vector import AutoresetMode, VectorEnv  # pyright: ignore
    from gymnasium.vector.utils import batch_space  # pyright: ignore

Infos = dict[str, Any]


class MapVectorEnv(VectorEnv):
    """A vector environment, stepped by one compiled program.

    It plays a task, in which one policy chooses, for a team for the robot whose turn it is; or the
    map MDP of one agent, whose observations are the `[N * 2D]` map. Action
    n < N looks at PoI n; action N is NOP. `action_mask` in the infos, `[E, N + 1]` int8, is 1 for
    the actions that exist. The methods are Gymnasium's.
    """

    def __init__(
        self,
        mdp: Mdp | Environment,
        *,
        num_envs: int = 1,
        starts: PyTree = None,
        # Quoted: where the site is built without Gymnasium, a stand-in has no `|`.
        autoreset_mode: "AutoresetMode | str" = AutoresetMode.NEXT_STEP,
        render_mode: str | None = None,
    ):
        """Makes the environments; `reset` must be called before the first step.

        Args:
          mdp: a task from `jaxsense.make`, or an MDP from `jaxsense.make_mdp`; `mdp.of(modality)`
            gives its robot another sensor.
          num_envs: how many environments, E.
          starts: from `interfaces.prepared_starts`, to start each episode from a random one; by
            default each start is new, at the cost of several steps.
          autoreset_mode: when an ended episode restarts, as in `gymnasium.vector`.
          render_mode: `rgb_array`, so that `render` draws the maps; only with a task.
        """
        self._played, self._starts = common.environment(mdp), starts
        checks.require_number("num_envs", num_envs)
        modes = ["rgb_array"] if isinstance(self._played, Task) else []
        if render_mode not in (None, *modes):
            raise ValueError(f"render_mode = {render_mode!r}: must be one of {[*modes, None]}")
        mode = AutoresetMode(autoreset_mode)
        self.metadata = {"render_modes": modes, "render_fps": 2, "autoreset_mode": mode}
        self.num_envs, self.render_mode = num_envs, render_mode
        single = common.spaces_of(spaces, self._played)
        self.single_observation_space, self.single_action_space = single
        self.observation_space, self.action_space = (batch_space(x, num_envs) for x in single)
        self._key, self._states = jax.random.key(0), None
        self._mask = np.ones((num_envs, self._played.num_actions), np.int8)
        self._ended = np.zeros(num_envs, bool)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, Infos]:
        """Starts new episodes; `reset_mask` in the options, `[E]` bool, restarts only some."""
        super().reset(seed=seed)
        if seed is not None or self._states is None:
            self._key = jax.random.key(int(self.np_random.integers(2**32)))
        given = (options or {}).get("reset_mask")
        mask = np.ones(self.num_envs, bool) if given is None else np.asarray(given)
        if mask.shape != (self.num_envs,) or mask.dtype != bool:
            raise ValueError(f"reset_mask = {given!r}: must hold {self.num_envs} booleans")
        if given is None:
            self._states = None
        return self._restarted(mask), self._infos()

    def step(
        self, actions: ArrayLike
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, Infos]:
        """Takes one action in each environment, `[E]` integers.

        Raises:
          ResetNeeded: before the first reset; in mode `DISABLED`, if an episode has ended.
          ValueError: if there is no such action.
        """
        actions, mode, ended = np.asarray(actions), self.metadata["autoreset_mode"], self._ended
        if self._states is None:
            raise error.ResetNeeded("step before reset")
        if mode is AutoresetMode.DISABLED and ended.any():
            raise error.ResetNeeded(f"environments {np.flatnonzero(ended)} have ended")
        if actions.dtype.kind not in "iu" or not self.action_space.contains(actions):
            raise ValueError(f"actions = {actions!r}: must be integers in {self.action_space}")
        self._key, self._states, found, mask = _step(
            self._key, self._played, self._states, actions.astype(np.int32)
        )
        self._mask = np.array(mask, np.int8)
        observations, rewards = np.array(found.observation), np.array(found.reward, np.float64)
        terminations, truncations = np.array(found.terminated), np.array(found.truncated)
        final = {}
        if mode is AutoresetMode.NEXT_STEP and ended.any():
            observations = self._restarted(ended)
            rewards[ended], terminations[ended], truncations[ended] = 0.0, False, False
        self._ended = terminations | truncations
        if mode is AutoresetMode.SAME_STEP and self._ended.any():
            final = _final(observations, self._mask, self._ended)
            observations = self._restarted(self._ended)
        return observations, rewards, terminations, truncations, {**self._infos(), **final}

    def action_masks(self) -> np.ndarray:
        """`[E, N + 1]` bool, the actions that exist, as sb3-contrib asks for them."""
        return self._mask.astype(bool)

    def render(self) -> tuple[np.ndarray, ...] | None:
        """`[H, W, 3]` uint8 picture of each map; None without a `render_mode`."""
        if self.render_mode is None:
            return None
        if self._states is None:
            raise error.ResetNeeded("render before reset")
        from jaxsense.show.task_plots import frames  # noqa: PLC0415  (matplotlib)

        return frames(self._played, self._states)  # pyright: ignore

    def _restarted(self, mask: np.ndarray) -> np.ndarray:
        """Observations after new starts where the mask is True."""
        self._key, observations, self._states, found = _start(
            self._key, self._played, self._starts, self._states, mask
        )
        self._ended = self._ended & ~mask
        self._mask = np.array(found, np.int8)
        return np.array(observations)

    def _infos(self) -> Infos:
        """Masks of existing actions, for all environments."""
        return {"action_mask": self._mask.copy(), "_action_mask": np.ones(self.num_envs, bool)}


class TaskEnv(Env):
    """A task as a single environment: `gymnasium.make("jaxsense/noisy-v0", agent="lidar")`.

    It is a `MapVectorEnv` of one. `action_mask` in the infos, `[N + 1]` int8, is 1 for the actions
    that exist. The methods are Gymnasium's.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 2}  # noqa: RUF012, as in `Env`

    def __init__(self, task: Task | str, agent: str | None = None, render_mode: str | None = None):
        """Makes the environment, see `make_vec`."""
        options = {"autoreset_mode": AutoresetMode.DISABLED, "render_mode": render_mode}
        self._envs = make_vec(task, 1, agent, **options)
        self.render_mode = render_mode
        self.observation_space = self._envs.single_observation_space
        self.action_space = self._envs.single_action_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, object] | None = None
    ) -> tuple[np.ndarray, Infos]:
        """Starts an episode; no options are read."""
        del options
        super().reset(seed=seed)
        observations, infos = self._envs.reset(seed=seed)
        return observations[0], {"action_mask": infos["action_mask"][0]}

    def step(self, action: SupportsInt) -> tuple[np.ndarray, float, bool, bool, Infos]:
        """Takes an action, see `MapVectorEnv.step`."""
        *found, infos = self._envs.step(np.asarray(action)[None])
        observation, reward, terminated, truncated = (x[0] for x in found)
        info = {"action_mask": infos["action_mask"][0]}
        return observation, float(reward), bool(terminated), bool(truncated), info

    def action_masks(self) -> np.ndarray:
        """`[N + 1]` bool, the actions that exist, as sb3-contrib asks for them."""
        return self._envs.action_masks()[0]

    def render(self) -> np.ndarray | None:
        """`[H, W, 3]` uint8 picture of the map; None without a `render_mode`."""
        return next(iter(self._envs.render() or ()), None)


def make_vec(
    task: Task | str,
    num_envs: int,
    agent: str | None = None,
    starts: int | None = None,
    **options: Any,
) -> MapVectorEnv:
    """Makes a vector environment: `gymnasium.make_vec("jaxsense/noisy-v0", num_envs=64)`.

    Args:
      task: from `jaxsense.make`, or its name.
      agent: whose sensor looks, see `jaxsense.make`; only with a name.
      starts: number of prepared starts; by default each start is new, see `MapVectorEnv`.
      options: `autoreset_mode` and `render_mode` of `MapVectorEnv`.
    """
    found = as_task(task, agent)
    prepared = None if starts is None else common.prepared_starts(jax.random.key(0), found, starts)
    return MapVectorEnv(found, num_envs=num_envs, starts=prepared, **options)


def _final(observations: np.ndarray, mask: np.ndarray, ended: np.ndarray) -> Infos:
    """Gymnasium's information about `[E]` bool `ended` episodes."""
    final = np.full(len(ended), None, object)
    for i in np.flatnonzero(ended):
        final[i] = observations[i]
    info = {"action_mask": np.where(ended[:, None], mask, 0), "_action_mask": ended}
    return {"final_obs": final, "_final_obs": ended, "final_info": info, "_final_info": ended}


@jax.jit
def _step(
    key: Key, played: Environment, states: PyTree, actions: jax.Array
) -> tuple[Key, PyTree, TimeStep, jax.Array]:
    """Next key, `[E]` states, `[E]` time steps and `[E, A]` actions that exist."""
    next_key, key = jax.random.split(key)
    keys = jax.random.split(key, len(actions))
    states, found = jax.vmap(played.step)(keys, states, actions)
    return next_key, states, found, jax.vmap(played.action_mask)(states)


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
