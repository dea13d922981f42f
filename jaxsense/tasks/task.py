"""Tasks: the MDP of one policy as a few pure functions, and those that are frozen.

A frozen task has fixed networks, and its looks are drawn from stored detections, so that scores
from different people can be compared. Its version is part of its name and changes with anything
that changes a score.
"""

import contextlib
from collections.abc import Callable, Iterator
from typing import TypeVar

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from jaxsense.config.section import require_32_bits
from jaxsense.core import checks
from jaxsense.core.types import Key, pytree
from jaxsense.dqn import episodes, policies, starts
from jaxsense.dqn import mdp as mdps
from jaxsense.dqn.episodes import Start
from jaxsense.dqn.mdp import Mdp, State
from jaxsense.dqn.policies import Known
from jaxsense.models import Models

M = TypeVar("M")

SEEDS = 10
"""Number of seeds of a score."""
EPISODES = 1024
"""Number of episodes of a score with each seed."""
CLIP = 10.0
"""Scaled observations are within plus and minus this."""

_FIRST_SEED = 2**31  # far from those that anybody trains with
_IMPLEMENTATION = "threefry2x32"  # of random numbers, in all scores

Act = Callable[[Key, M, jax.Array], tuple[jax.Array, M]]
"""`(key, memory, observation [S]) -> []` int32 action, and the memory after it."""


@pytree
class Scaling:
    """Brings the numbers of an observation to about the same size, the same way for every PoI.

    Attributes:
      offset: `[F]` means over states that random looks lead to.
      scale: `[F]` their standard deviations.
    """

    offset: jax.Array
    scale: jax.Array

    def __call__(self, features: Float[Array, "N F"]) -> Float[Array, " S"]:
        """Observation of scaled features, PoI by PoI."""
        scaled = (features - self.offset[None]) / self.scale[None]
        return jnp.clip(scaled, -CLIP, CLIP).reshape(-1)

    def inverse(self, observation: Float[Array, " S"]) -> Float[Array, "N F"]:
        """Features that a scaled observation stands for, but for what was clipped."""
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
        state = starts.reset(key, self.mdp)
        return self.observe(state), state

    def observe(self, state: State) -> Float[Array, " S"]:
        """What the robot sees that chooses."""
        return self.seen_by(state.agent, state)

    def seen_by(self, robot: Int[Array, ""], state: State) -> Float[Array, " S"]:
        """What a robot sees of a state."""
        times = self.mdp.times(state)
        return self.scaled(self.mdp.features(state.belief, state.team, times, robot))

    def scaled(self, features: Float[Array, "N F"]) -> Float[Array, " S"]:
        """Features of all PoIs as an observation; here as they are."""
        return features.reshape(-1)

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


@pytree
class Task(Environment):
    """A frozen task: an environment with fixed networks and looks; a pytree.

    In the MDP of one robot, it looks at PoIs until it has seen enough, and dynamic programming
    finds the optimum, see `dqn.episodes.reference`. In that of a team, robots drive and look, and
    time has a cost; nobody knows the optimum, and the references are rules of `dqn.POLICIES`.

    Attributes:
      models: frozen networks, of which only those that the references read are there, and the agent
        that learns in the preset of the task.
      returns: `[R, seeds]` mean return of each reference with each seed of a score, see
        `registry.reference_returns`.
      agent: who acts: the name of a sensor, or `team` for all robots.
    """

    models: Models
    scaling: Scaling
    returns: jax.Array
    name: str = struct.field(pytree_node=False)
    agent: str = struct.field(pytree_node=False)
    modalities: tuple[str, ...] = struct.field(pytree_node=False)
    bound = CLIP

    def __repr__(self) -> str:
        """How to make the task; its numbers would fill pages."""
        return f"jaxsense.make({self.name!r}, {self.agent!r})"

    @property
    def has_optimum(self) -> bool:
        """Whether the first of `references` is optimal."""
        return self.mdp.teams is None

    @property
    def references(self) -> tuple[str, ...]:
        """Names of the policies that `play_reference` plays, to compare with."""
        if self.has_optimum:
            return "optimal", "greedy", "naive", "random"
        return "nearest", "auction", "rollout", "naive", "random"

    def scaled(self, features: Float[Array, "N F"]) -> Float[Array, " S"]:
        """See `Environment.scaled`."""
        return self.scaling(features)

    def play(self, key: Key, act: Act[M], memory: M) -> Float[Array, ""]:
        """Total reward of an episode with a policy, without discount.

        Args:
          key: random key; with the same one all policies start from the same state, and of one
            robot, the k-th look at a PoI shows the same to all.
          memory: before the first action.
        """

        def choose(key: Key, known: Known, memory: M) -> tuple[jax.Array, M]:
            seen = self.mdp.features(known.belief, known.team, known.times, known.robot)
            action, memory = act(key, memory, self.scaled(seen))
            return known.team.existing(action), memory

        start, key = self._start(key)
        return episodes.run_episode(key, self.mdp, self.models.bayes, choose, start, memory)[0]

    def play_reference(self, key: Key, name: str) -> Float[Array, ""]:
        """The same with one of `references`; `name` is static."""
        exact, (start, key) = self.models.bayes, self._start(key)
        optimal = None
        if name == "optimal":
            # The same in every episode, so that it is simulated once.
            optimal = episodes.reference(_key(0), self.mdp, self.models, exact.labels)

        def choose(key: Key, known: Known, memory: tuple[()]) -> tuple[jax.Array, tuple[()]]:
            if optimal is None:
                values = {**policies.POLICIES, **policies.UNORDERED}[name](key, self.models, known)
            else:
                values = optimal(known, start.state.classes)
            of_present = jnp.where(known.team.action_mask, values, -jnp.inf)
            return policies.best(of_present), memory

        return episodes.run_episode(key, self.mdp, exact, choose, start)[0]

    def _start(self, key: Key) -> tuple[Start, Key]:
        """The first state, and a key of what follows."""
        start_key, play_key = jax.random.split(key)
        return episodes.reset(start_key, self.mdp, self.models.bayes), play_key


@contextlib.contextmanager
def fixed_draws() -> Iterator[None]:
    """Context in which a key yields the same numbers whatever JAX's settings are."""
    with jax.threefry_partitionable(True), jax.default_prng_impl(_IMPLEMENTATION):
        yield


def key_of_seed(seed: int) -> Key:
    """The key of the episodes of a score with a seed, from 0; no training has it."""
    return _key(_FIRST_SEED + seed)


def _key(seed: int) -> Key:
    """`jax.random.key` of a 32-bit seed, whatever JAX's settings are."""
    return jax.random.wrap_key_data(jnp.array([0, seed], jnp.uint32), impl=_IMPLEMENTATION)
