"""What a task is to those who learn in it: an MDP of one policy, as a few pure functions."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxsense.config.section import require_32_bits
from jaxsense.core import checks
from jaxsense.core.types import Key, pytree
from jaxsense.dqn import mdp as mdps
from jaxsense.dqn.mdp import Mdp, State

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
class Environment:
    """An environment in which one policy makes all choices; a pytree.

    Robots choose in turn, and each observation is what the robot knows whose turn it is.

    Attributes:
      bound: observations are within plus and minus this.
    """

    mdp: Mdp
    bound = float("inf")

    @property
    def num_actions(self) -> int:
        """A: a look at each PoI, and NOP, the last, which ends the robot's work."""
        return self.mdp.num_actions

    @property
    def max_steps(self) -> int:
        """Actions after which an episode is truncated."""
        return int(self.mdp.config.max_steps)

    @property
    def observation_size(self) -> int:
        """S, the features of all PoIs."""
        return self.mdp.num_features * self.mdp.num_pois

    def reset(self, key: Key) -> tuple[Float[Array, " S"], State]:
        """Starts an episode: the observation, and the state."""
        require_32_bits()
        state = mdps.reset(key, self.mdp)
        return self.observe(state), state

    def observe(self, state: State) -> Float[Array, " S"]:
        """What the agent sees of a state: its features."""
        return self.features(state).reshape(-1)

    def features(self, state: State) -> Float[Array, "N F"]:
        """What an observation holds of each PoI, not yet scaled."""
        return self.mdp.features(state.belief, state.team, self.mdp.times(state), state.agent)

    def action_mask(self, state: State) -> Bool[Array, " A"]:
        """The actions that exist in a state."""
        return state.team.action_mask

    def step(self, key: Key, state: State, action: Int[Array, ""]) -> tuple[State, TimeStep]:
        """Takes an action; a PoI that is not present counts as NOP.

        Returns:
          The next state, and what the agent sees of it. The reward is that of the look, if there
          was one, less the price of the time of all robots. An episode that has ended goes on.
        """
        checks.require_type("state", state, State, "as from reset")
        checks.require_shape("action", action, ())
        checks.require_index("action", action, self.num_actions)
        after, outcome = mdps.step(key, self.mdp, state, state.team.existing(action))
        seen, reward = self.observe(after), self.mdp.earned(outcome, after.team)
        return after, TimeStep(seen, reward, outcome.terminated, outcome.truncated)
