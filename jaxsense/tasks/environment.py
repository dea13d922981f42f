"""What a task is to those who learn in it: an MDP of one policy, as a few pure functions."""

from typing import Any, Protocol

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxsense.core.types import Key, pytree
from jaxsense.dqn.map_mdp import MapMdp
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

    @property
    def bound(self) -> float:
        """Observations are within plus and minus this."""
        return CLIP

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
      observation: `[S]` float32 after the action.
      reward: `[]` float32.
      terminated: `[]` bool, the agent has ended the episode.
      truncated: `[]` bool, the episode has reached its limit of steps.
    """

    observation: jax.Array
    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array


class Environment(Protocol):
    """An environment in which one policy makes all choices; a pytree.

    Attributes:
      mdp: the MDP.
      num_actions: A; the last action is NOP, which ends the agent's work.
      observation_size: S.
      bound: observations are within plus and minus this.
      max_steps: actions after which an episode is truncated.
    """

    @property
    def mdp(self) -> MapMdp | TeamMdp:
        """The MDP."""
        ...

    @property
    def num_actions(self) -> int:
        """A."""
        ...

    @property
    def observation_size(self) -> int:
        """S."""
        ...

    @property
    def bound(self) -> float:
        """Of observations."""
        ...

    @property
    def max_steps(self) -> int:
        """Actions in an episode, at most."""
        ...

    def reset(self, key: Key) -> tuple[Float[Array, " S"], Any]:
        """Starts an episode.

        Args:
          key: random key.

        Returns:
          `[S]` observation, and the state.
        """
        ...

    def observe(self, state: Any) -> Float[Array, " S"]:
        """What the agent sees of a state."""
        ...

    def action_mask(self, state: Any) -> Bool[Array, " A"]:
        """`[A]` bool, the actions that exist in a state."""
        ...

    def step(self, key: Key, state: Any, action: Int[Array, ""]) -> tuple[Any, TimeStep]:
        """Takes an action. An episode that has ended is not restarted.

        Args:
          key: random key.
          state: from `reset` or `step`.
          action: `[]` int32.

        Returns:
          The next state, and what the agent sees of it.
        """
        ...
