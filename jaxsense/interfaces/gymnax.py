"""The map MDP as an environment of gymnax 1.x: `pip install 'jaxsense[gymnax]'`."""

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from jaxsense.core.types import Key
from jaxsense.dqn import map_mdp
from jaxsense.dqn.map_agent import observation
from jaxsense.dqn.map_mdp import MapMdp, MapState
from jaxsense.interfaces import common
from jaxsense.interfaces.extras import extra

with extra("gymnax"):
    from gymnax.environments import environment, spaces  # pyright: ignore[reportMissingImports]


@struct.dataclass
class MapEnvState(environment.EnvState):
    """The state of an environment.

    Attributes:
      time: `[]` int32 actions so far.
      map: the state of the MDP.
      terminated: `[]` bool, the last action was NOP.
    """

    map: MapState
    terminated: jax.Array


@struct.dataclass
class MapEnvParams(environment.EnvParams):
    """Parameters of an environment.

    Attributes:
      max_steps_in_episode: actions after which an episode is truncated.
      starts: `[S]` from `interfaces.prepared_starts`, to start each episode from a random one; None
        for new starts, which are slow: gymnax makes one in every step.
    """

    max_steps_in_episode: int = 20
    starts: MapState | None = None


class MapEnv(environment.Environment[MapEnvState, MapEnvParams]):
    """The map MDP of one agent.

    An observation is the `[N * 2D]` map, see `dqn.observation`. Action n < N looks at PoI n; action
    N is NOP and terminates the episode. The methods are gymnax's.
    """

    def __init__(self, mdp: MapMdp, modality: int):
        """Makes the environment.

        Args:
          mdp: the MDP, of one agent, see `jaxsense.make_mdp`.
          modality: index of the agent's own sensor.

        Raises:
          ValueError: if there is no such sensor.
        """
        common.check_modality(mdp, modality)
        self.mdp = mdp
        self.modality = modality

    @property
    def default_params(self) -> MapEnvParams:
        """Parameters with the MDP's episode length and a new start for each episode."""
        return MapEnvParams(max_steps_in_episode=self.mdp.config.max_steps)

    def prepared_params(self, key: Key, number: int) -> MapEnvParams:
        """Default parameters with prepared starts, which make training far faster.

        Args:
          key: random key.
          number: of starts.
        """
        starts = common.prepared_starts(key, self.mdp, number)
        return self.default_params.replace(starts=starts)  # pyright: ignore

    def reset_env(self, key: Key, params: MapEnvParams) -> tuple[jax.Array, MapEnvState]:
        """Starts an episode.

        Args:
          key: random key.
          params: of the environment.
        """
        start = common.start(key, self.mdp, params.starts)
        state = MapEnvState(time=start.steps, map=start, terminated=jnp.bool_(False))  # pyright: ignore
        return self.observe(key, state, None, params), state

    def step_env(
        self, key: Key, state: MapEnvState, action: Any, params: MapEnvParams
    ) -> tuple[jax.Array, MapEnvState, jax.Array, jax.Array, dict[Any, Any]]:
        """Takes one action, without a reset.

        Args:
          key: random key.
          state: the current state.
          action: `[]` integer, a PoI or N for NOP.
          params: of the environment.

        Returns:
          Observation, state, reward, whether NOP has ended the episode, and info.

        Raises:
          ValueError: if the action is no integer, or does not exist and is not traced.
        """
        after, outcome = map_mdp.step(key, self.mdp, state.map, jnp.asarray(action), self.modality)
        state = MapEnvState(time=after.steps, map=after, terminated=outcome.terminated)  # pyright: ignore
        info = {"discount": self.discount(state, params)}
        observation = self.observe(key, state, action, params)
        return observation, state, outcome.reward, outcome.terminated, info

    def observe(self, key: Key, state: MapEnvState, action: Any, params: MapEnvParams) -> jax.Array:
        """The map, `[N * 2D]`.

        Args:
          key: not used.
          state: the current state.
          action: not used.
          params: not used.
        """
        del key, action, params
        return observation(state.map.belief)

    def is_terminated(self, state: MapEnvState, params: MapEnvParams) -> jax.Array:
        """Whether the last action was NOP, `[]` bool.

        Args:
          state: the current state.
          params: not used.
        """
        del params
        return state.terminated

    def is_truncated(self, state: MapEnvState, params: MapEnvParams) -> jax.Array:
        """Whether the episode reached its limit without NOP, `[]` bool.

        Args:
          state: the current state.
          params: of the environment.
        """
        return ~state.terminated & (state.time >= params.max_steps_in_episode)

    @property
    def name(self) -> str:
        """Name of the environment."""
        return "jaxsense-Map"

    @property
    def num_actions(self) -> int:
        """Number of actions: a look at each PoI, and NOP."""
        return self.mdp.num_pois + 1

    def action_space(self, params: MapEnvParams | None = None) -> spaces.Discrete:
        """Space of the actions: a look at each PoI, and NOP."""
        del params
        return common.map_spaces(spaces, self.mdp)[1]

    def observation_space(self, params: MapEnvParams | None = None) -> spaces.Box:
        """Space of the map."""
        del params
        return common.map_spaces(spaces, self.mdp)[0]
