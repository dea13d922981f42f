"""Tasks and the map MDP in gymnax 1.x: `pip install 'jaxsense[gymnax]'`.

The import registers every task by its name, for `gymnax.make("noisy-v0", agent="camera")`.
"""

import functools

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import PyTree

from jaxsense.core.types import Key, pytree
from jaxsense.dqn.mdp import Mdp
from jaxsense.interfaces import common
from jaxsense.tasks import Environment, make, registered

with common.extra("gymnax"):
    from gymnax import register, registered_envs  # pyright: ignore[reportMissingImports]
    from gymnax.environments import environment, spaces  # pyright: ignore[reportMissingImports]


@pytree  # pyright: ignore[reportGeneralTypeIssues]
class MapEnvState(environment.EnvState):
    """State of `MapEnv`.

    Attributes:
      time: `[]` int32 actions so far.
      map: the state of the MDP.
      terminated: `[]` bool, the last action was NOP.
    """

    map: PyTree
    terminated: jax.Array


@pytree  # pyright: ignore[reportGeneralTypeIssues]
class MapEnvParams(environment.EnvParams):
    """Parameters of `MapEnv`.

    Attributes:
      max_steps_in_episode: actions after which an episode is truncated.
      starts: from `interfaces.prepared_starts`, to start each episode from a random one; None for
        new starts, which are slow: gymnax makes one in every step.
    """

    max_steps_in_episode: int = 20
    starts: PyTree = None


class MapEnv(environment.Environment[MapEnvState, MapEnvParams]):
    """A task, or the map MDP of one agent, as an environment of gymnax 1.x.

    Observations and actions are those of `jaxsense.interfaces.gymnasium.MapVectorEnv`.
    `action_mask` in the infos, `[N + 1]` bool, are the actions that exist after the step, before
    the next episode. The methods are gymnax's.
    """

    def __init__(self, mdp: Mdp | Environment):
        """Makes the environment of a task, or of an MDP; see `MapVectorEnv`."""
        self.played = common.environment(mdp)

    @property
    def default_params(self) -> MapEnvParams:
        """Parameters with the MDP's episode length and a new start for each episode."""
        return MapEnvParams(max_steps_in_episode=self.played.max_steps)

    def prepared_params(self, key: Key, number: int) -> MapEnvParams:
        """Default parameters with prepared starts, which make training far faster."""
        starts = common.prepared_starts(key, self.played, number)
        return self.default_params.replace(starts=starts)  # pyright: ignore

    def reset_env(self, key: Key, params: MapEnvParams) -> tuple[jax.Array, MapEnvState]:
        """Starts an episode."""
        seen, start = common.start(key, self.played, params.starts)
        return seen, MapEnvState(time=jnp.int32(0), map=start, terminated=jnp.bool_(False))  # pyright: ignore

    def step_env(
        self, key: Key, state: MapEnvState, action: ArrayLike, params: MapEnvParams
    ) -> tuple[jax.Array, MapEnvState, jax.Array, jax.Array, dict[str, jax.Array]]:
        """Takes one action, without a reset."""
        after, found = self.played.step(key, state.map, jnp.asarray(action))
        state = MapEnvState(time=state.time + 1, map=after, terminated=found.terminated)  # pyright: ignore
        info = {"discount": self.discount(state, params), "action_mask": self.action_mask(state)}
        return found.observation, state, found.reward, found.terminated, info

    def action_mask(self, state: MapEnvState) -> jax.Array:
        """`[N + 1]` bool, the actions that exist."""
        return self.played.action_mask(state.map)

    def is_terminated(self, state: MapEnvState, params: MapEnvParams) -> jax.Array:
        """Whether the last action was NOP, `[]` bool."""
        del params
        return state.terminated

    def is_truncated(self, state: MapEnvState, params: MapEnvParams) -> jax.Array:
        """Whether the episode reached its limit without NOP, `[]` bool."""
        return ~state.terminated & (state.time >= params.max_steps_in_episode)

    @property
    def num_actions(self) -> int:
        """A look at each PoI, and NOP."""
        return self.played.num_actions

    def action_space(self, params: MapEnvParams | None = None) -> spaces.Discrete:
        """Space of the actions."""
        return common.spaces_of(spaces, self.played)[1]

    def observation_space(self, params: MapEnvParams | None = None) -> spaces.Box:
        """Space of the observations."""
        return common.spaces_of(spaces, self.played)[0]


# gymnax makes environments static: two of the same task would compile everything twice.
@functools.cache
def make_env(name: str, agent: str | None = None) -> MapEnv:
    """The environment of a task, see `jaxsense.make`; the same one in every call."""
    return MapEnv(make(name, agent))


for _name in registered():
    if _name not in registered_envs:
        register(_name, functools.partial(make_env, _name))
