"""Tasks that stay as they are, so that scores from different people can be compared.

A task is an MDP with frozen networks whose looks are drawn from stored detections. Its version is
part of its name and changes with anything that changes a score.
"""

import abc
import contextlib
from collections.abc import Callable, Iterator
from typing import ClassVar, TypeVar

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int, PyTree

from jaxsense.core import checks
from jaxsense.core.types import Key, pytree
from jaxsense.dqn import episodes, policies, team_mdp
from jaxsense.dqn.episodes import Start
from jaxsense.dqn.policies import Agent, Known
from jaxsense.dqn.team_agent import TeamEnvironment
from jaxsense.dqn.team_mdp import TeamMdp, TeamState
from jaxsense.models import Models
from jaxsense.tasks.environment import CLIP, Environment, OneAgent, Scaling, TimeStep, of_belief

M = TypeVar("M")

SEEDS = 10
"""Number of seeds of a score."""
EPISODES = 1024
"""Number of episodes of a score with each seed."""

_FIRST_SEED = 2**31  # far from those that anybody trains with
_IMPLEMENTATION = "threefry2x32"  # of random numbers, in all scores

Act = Callable[[Key, M, jax.Array], tuple[jax.Array, M]]
"""`(key, memory, observation [S]) -> []` int32 action, and the memory after it."""


@pytree
class Task(Environment):
    """A frozen task: an environment with fixed networks and looks; a pytree.

    Attributes:
      models: frozen networks, of which only those that the references read are there, and the agent
        that learns in the preset of the task.
      returns: `[R, seeds]` mean return of each reference with each seed of a score, see
        `registry.reference_returns`.
      agent: who acts: the name of a sensor, or `team` for all robots.
      references: names of the policies that `play_reference` plays, to compare with.
      has_optimum: whether the first one is optimal.
    """

    models: Models
    scaling: Scaling
    returns: jax.Array
    name: str = struct.field(pytree_node=False)
    agent: str = struct.field(pytree_node=False)
    modalities: tuple[str, ...] = struct.field(pytree_node=False)
    references: ClassVar[tuple[str, ...]]
    has_optimum: ClassVar[bool]
    bound = CLIP

    def __repr__(self) -> str:
        """How to make the task; its numbers would fill pages."""
        return f"jaxsense.make({self.name!r}, {self.agent!r})"

    def observe(self, state: PyTree) -> Float[Array, " S"]:
        """What the agent sees of a state: its features, scaled."""
        return self.scaling(self.features(state))

    @abc.abstractmethod
    def learning(self, agent: Agent) -> PyTree:
        """What `dqn.train` learns in with `models.agent`, perhaps with other settings."""

    @abc.abstractmethod
    def inputs(self, observation: Float[Array, " S"]) -> Float[Array, " S"]:
        """What an agent's Q-network reads, from an observation of the task."""

    @abc.abstractmethod
    def play(self, key: Key, act: Act[M], memory: M) -> Float[Array, ""]:
        """Total reward of an episode with a policy, without discount.

        Args:
          key: random key; with the same one all policies start from the same state.
          act: the policy.
          memory: before the first action.
        """

    @abc.abstractmethod
    def play_reference(self, key: Key, name: str) -> Float[Array, ""]:
        """The same with one of `references`; `name` is static."""


@pytree
class MapTask(Task, OneAgent):
    """A task in the map MDP: one agent looks at PoIs until it has seen enough.

    Dynamic programming finds the optimum, see `dqn.episodes.reference`.
    """

    references = ("optimal", "greedy", "naive", "random")
    has_optimum = True
    __repr__ = Task.__repr__

    def learning(self, agent: Agent) -> PyTree:
        """The map MDP, see `Task.learning`."""
        return agent.environment(self.mdp, self.modality)

    def inputs(self, observation: Float[Array, " S"]) -> Float[Array, " S"]:
        """The map, see `Task.inputs`."""
        return self.scaling.inverse(observation).reshape(-1)

    def play(self, key: Key, act: Act[M], memory: M) -> Float[Array, ""]:
        """Plays an episode, see `Task.play`; the k-th look at a PoI shows the same to all."""

        def choose(key: Key, known: Known, memory: M) -> tuple[jax.Array, M]:
            return act(key, memory, self.scaling(of_belief(known.belief)))

        exact, (start, key) = self.models.bayes, self._start(key)
        return episodes.run_recurrent(key, self.mdp, exact, choose, memory, start, self.modality)[0]

    def play_reference(self, key: Key, name: str) -> Float[Array, ""]:
        """Plays an episode with one of `references`, see `Task.play_reference`."""
        exact, (start, key) = self.models.bayes, self._start(key)
        # The same in every episode, so that it is simulated once.
        table_key = _key(0)
        best = episodes.reference(table_key, self.mdp, self.modality, self.models, exact.labels)

        def choose(key: Key, known: Known) -> jax.Array:
            if name == self.references[0]:
                return policies.best(best(known, start.state.classes))
            return policies.best(policies.POLICIES[name].values(key, self.models, known))

        return episodes.run_episode(key, self.mdp, exact, choose, start, self.modality)[0]

    def _start(self, key: Key) -> tuple[Start, Key]:
        """The first state, and a key of what follows."""
        start_key, play_key = jax.random.split(key)
        return episodes.reset(start_key, self.mdp, self.models.bayes), play_key


@pytree
class TeamTask(Task):
    """A task in the team MDP: robots choose in turn, drive and look, and time has a cost.

    One policy chooses for all robots; each observation is what the robot knows whose turn it is.
    Nobody knows the optimum; the references are rules of `dqn.POLICIES`.

    Attributes:
      robots: `[R]` int32 index of each robot's sensor.
    """

    mdp: TeamMdp
    robots: jax.Array
    references = ("nearest", "auction", "rollout", "naive", "random")
    has_optimum = False
    __repr__ = Task.__repr__

    def start(self, key: Key) -> TeamState:
        """The first state of an episode."""
        return team_mdp.reset(key, self.mdp, self.robots)

    def features(self, state: TeamState) -> Float[Array, "N F"]:
        """What the robot knows whose turn it is, not yet scaled."""
        return self.mdp.observe(state, state.agent).T

    def learning(self, agent: Agent) -> PyTree:
        """The team MDP with the robots of the task, see `Task.learning`."""
        return TeamEnvironment(agent, self.mdp, self.robots)

    def inputs(self, observation: Float[Array, " S"]) -> Float[Array, " S"]:
        """What the robot knows whose turn it is, see `Task.inputs`."""
        features = self.scaling.inverse(observation).T
        # Networks ask whether a PoI's presence is above 0, which rounding must not decide.
        return features.at[-3].set(jnp.round(features[-3])).reshape(-1)

    def action_mask(self, state: TeamState) -> Bool[Array, " A"]:
        """The PoIs that are present, and NOP."""
        return team_mdp.action_mask(state)

    def step(
        self, key: Key, state: TeamState, action: Int[Array, ""]
    ) -> tuple[TeamState, TimeStep]:
        """Lets the robot choose whose turn it is, see `Task.step`.

        A PoI that is not present counts as NOP. The reward is that of the look, if there was one,
        less the price of the time of all robots.
        """
        checks.require_type("state", state, TeamState, "as from reset")
        after, outcome = team_mdp.step(key, self.mdp, state, team_mdp.existing(state, action))
        price = self.mdp.time_price(after.team, jnp.asarray(outcome.seconds))
        seen, reward = self.observe(after), outcome.reward - price
        return after, TimeStep(seen, reward, outcome.terminated, outcome.truncated)

    def play(self, key: Key, act: Act[M], memory: M) -> Float[Array, ""]:
        """Plays an episode, see `Task.play`."""

        def choose(key: Key, state: TeamState, known: Known, memory: M) -> tuple[jax.Array, M]:
            del known
            action, memory = act(key, memory, self.observe(state))
            return team_mdp.existing(state, action), memory

        return self._play(key, choose, memory)

    def play_reference(self, key: Key, name: str) -> Float[Array, ""]:
        """Plays an episode with one of `references`, see `Task.play_reference`."""

        def choose(key: Key, state: TeamState, known: Known, memory: M) -> tuple[jax.Array, M]:
            values = policies.POLICIES[name].values(key, self.models, known)
            values = jnp.where(self.action_mask(state), values, -jnp.inf)
            return policies.best(values), memory

        return self._play(key, choose, ())

    def _play(self, key: Key, choose: Callable[..., tuple[jax.Array, M]], memory: M) -> jax.Array:
        """Total reward of an episode."""
        start_key, play_key = jax.random.split(key)
        return episodes.run_team(play_key, self.mdp, choose, memory, self.start(start_key))


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
