"""What a task is to those who learn in it: an MDP of one policy, as a few pure functions."""

import abc

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int, PyTree

from jaxsense.config.section import require_32_bits
from jaxsense.core.types import Belief, Key, pytree
from jaxsense.dqn import map_mdp
from jaxsense.dqn.map_agent import observation
from jaxsense.dqn.map_mdp import MapMdp, MapState
from jaxsense.dqn.team_mdp import TeamMdp

CLIP = 10.0
"""Scaled observations are within plus and minus this."""


@pytree
class Scaling:
    """Brings the numbers of an observation to about the same size, the same way for every PoI.

    Attributes:
      offset: `[F]` means over states that random looks lead to.
      scale: `[F]` their standard deviations.
    """

    offset: jax.Array
    scale: jax.Array
    bound = CLIP

    def __call__(self, features: Float[Array, "N F"]) -> Float[Array, " S"]:
        """`[N * F]` scaled from `[N, F]`, PoI by PoI."""
        scaled = (features - self.offset[None]) / self.scale[None]
        return jnp.clip(scaled, -CLIP, CLIP).reshape(-1)

    def inverse(self, observation: Float[Array, " S"]) -> Float[Array, "N F"]:
        """`[N, F]` from `[N * F]` scaled, but for what was clipped."""
        scaled = observation.reshape(-1, self.offset.size)
        return scaled * self.scale[None] + self.offset[None]


@pytree
class TimeStep:
    """Output of a step: observation, reward, and whether the episode has ended.

    Attributes:
      terminated: `[]` bool, the agent has ended the episode.
      truncated: `[]` bool, the episode has reached its limit of steps.
    """

    observation: jax.Array
    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array


@pytree
class Environment(abc.ABC):
    """An environment in which one policy makes all choices; a pytree.

    Attributes:
      bound: observations are within plus and minus this.
    """

    mdp: MapMdp | TeamMdp
    bound = float("inf")

    @property
    def num_actions(self) -> int:
        """A: a look at each PoI, and NOP, the last, which ends the agent's work."""
        return self.mdp.map.num_pois + 1

    @property
    def max_steps(self) -> int:
        """Actions after which an episode is truncated."""
        return int(self.mdp.max_steps)

    @property
    def observation_size(self) -> int:
        """S, the features of all PoIs."""
        return self.mdp.num_features * self.mdp.map.num_pois

    def reset(self, key: Key) -> tuple[Float[Array, " S"], PyTree]:
        """Starts an episode: the observation, and the state."""
        require_32_bits()
        state = self.start(key)
        return self.observe(state), state

    def observe(self, state: PyTree) -> Float[Array, " S"]:
        """What the agent sees of a state: its features."""
        return self.features(state).reshape(-1)

    @abc.abstractmethod
    def start(self, key: Key) -> PyTree:
        """The first state of an episode."""

    @abc.abstractmethod
    def features(self, state: PyTree) -> Float[Array, "N F"]:
        """What an observation holds of each PoI, not yet scaled."""

    @abc.abstractmethod
    def action_mask(self, state: PyTree) -> Bool[Array, " A"]:
        """The actions that exist in a state."""

    @abc.abstractmethod
    def step(self, key: Key, state: PyTree, action: Int[Array, ""]) -> tuple[PyTree, TimeStep]:
        """The next state, and what the agent sees of it. An episode that has ended goes on."""


@pytree
class OneAgent(Environment):
    """The map MDP of one agent, see `Environment`.

    Attributes:
      modality: index of the agent's own sensor.
    """

    mdp: MapMdp
    modality: int = struct.field(pytree_node=False)

    def start(self, key: Key) -> MapState:
        """The first state of an episode."""
        return map_mdp.reset(key, self.mdp)

    def features(self, state: MapState) -> Float[Array, "N F"]:
        """Mean and standard deviation of each PoI's belief."""
        return of_belief(state.belief)

    def action_mask(self, state: MapState) -> Bool[Array, " A"]:
        """All actions exist."""
        del state
        return jnp.ones(self.num_actions, bool)

    def step(self, key: Key, state: MapState, action: Int[Array, ""]) -> tuple[MapState, TimeStep]:
        """Takes an action, see `Environment.step`."""
        after, outcome = map_mdp.step(key, self.mdp, state, action, self.modality)
        seen = self.observe(after)
        return after, TimeStep(seen, outcome.reward, outcome.terminated, outcome.truncated)


def of_belief(belief: Belief) -> Float[Array, "N F"]:
    """Mean and standard deviation of each PoI's belief."""
    return observation(belief).reshape(len(belief.mean), -1)
