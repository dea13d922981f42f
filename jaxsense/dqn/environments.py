"""Adapts the map MDP and the team MDP to one interface for Q-learning, and defines agents'."""

from collections.abc import Callable
from typing import Generic, Protocol, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

from jaxsense.core.networks import Params
from jaxsense.core.types import Belief, Index, Key, Transition, pytree
from jaxsense.dqn import map_mdp, team_mdp
from jaxsense.dqn.map_mdp import MapMdp, MapState, Outcome
from jaxsense.dqn.places import Places
from jaxsense.dqn.pooling import PoolingNetwork
from jaxsense.dqn.team_mdp import Names, Team, TeamMdp, TeamState

S = TypeVar("S")


class Agent(Protocol):
    """How a Q-network is used; a frozen pytree. Its parameters are kept apart.

    Attributes:
      counts_time: whether the values of `decide` include travel time, so that no other rule needs
        to break ties.
    """

    @property
    def counts_time(self) -> bool:
        """Whether values include travel time."""
        ...

    @property
    def tour_networks(self) -> tuple[PoolingNetwork] | tuple[()]:
        """The network that orders looks; none if looks take no time."""
        ...

    def learner(self, modality: str) -> str:
        """The name of what learns for robots of a modality; several may share it."""
        ...

    def plays(self, num_pois: int) -> bool:
        """Whether the Q-network is for this number of PoIs."""
        ...

    def with_discount(self, *, step: float, second: float) -> "Agent":
        """The agent with another discount factor, of which it takes that of its unit of time.

        Args:
          step: factor of a step, for an agent whose actions take no time.
          second: factor of a second.
        """
        ...

    def mdp(
        self, of_number: Callable[[int], MapMdp], places: Places, names: Names
    ) -> MapMdp | TeamMdp:
        """The MDP in which the agent acts.

        Args:
          of_number: number of PoIs to the map MDP.
          places: draws positions of PoIs and robots, for the team MDP.
          names: of the sensors.
        """
        ...

    def environment(self, mdp: PyTree, modality: Index) -> "Environment[PyTree]":
        """What the agent learns in.

        Args:
          mdp: from `mdp`.
          modality: index of the agent's own sensor.
        """
        ...

    def init(self, key: Key) -> Params:
        """Random parameters of the Q-network."""
        ...

    def init_tours(self, key: Key) -> tuple[Params, ...]:
        """Random parameters of `tour_networks`."""
        ...

    def observe(self, belief: Belief, team: Team, robot: Int[Array, ""]) -> Float[Array, " S"]:
        """Input of a robot's network.

        Args:
          belief: `[N, D]` the map.
          team: robots and PoIs at this moment.
          robot: `[]` int32, the robot that chooses.
        """
        ...

    def q(self, params: Params, observed: Float[Array, "S ..."]) -> Float[Array, "A ..."]:
        """What learning predicts: each action's reward and the discounted best value after it.

        Args:
          params: of the Q-network.
          observed: `[S]`, or `[S, B]`.

        Returns:
          `[A]`, or `[A, B]`; NOP's last.
        """
        ...

    def values(self, params: Params, observed: Float[Array, "S ..."]) -> Float[Array, "A ..."]:
        """Values of choosing actions now, the highest of which is best.

        Args:
          params: of the Q-network.
          observed: `[S]`, or `[S, B]`.

        Returns:
          `[A]`, or `[A, B]`; NOP's last.
        """
        ...

    def decide(
        self,
        params: Params,
        tour_params: tuple[Params, ...],
        classes: Belief,
        belief: Belief,
        team: Team,
        robot: Int[Array, ""],
    ) -> Float[Array, " A"]:
        """Values of a robot's actions in a mission, `[N + 1]`, NOP's last.

        Args:
          params: of the robot's Q-network.
          tour_params: of `tour_networks`, or none.
          classes: `[C, D]` joint posterior of each class.
          belief: `[N, D]` the map.
          team: robots and PoIs at this moment; PoIs that are not present are never chosen.
          robot: `[]` int32, the robot that chooses.
        """
        ...

    def worth(
        self,
        params: Params,
        classes: Belief,
        belief: Belief,
        team: Team,
        robot: Int[Array, ""],
    ) -> Float[Array, " N"]:
        """What a look at each PoI is worth, `[N]`: its value minus NOP's, if no other is left.

        Args:
          params: of the robot's Q-network.
          classes: `[C, D]` joint posterior of each class.
          belief: `[N, D]` the map.
          team: robots and PoIs at this moment.
          robot: `[]` int32, the robot that chooses.
        """
        ...


class Environment(Protocol, Generic[S]):
    """An environment of one learner; a frozen pytree.

    Attributes:
      agent: the learner.
      mdp: the MDP.
      num_actions: A; the last action is NOP.
    """

    @property
    def agent(self) -> Agent:
        """The learner."""
        ...

    @property
    def mdp(self) -> MapMdp | TeamMdp:
        """The MDP."""
        ...

    @property
    def num_actions(self) -> int:
        """A."""
        ...

    def reset(self, key: Key) -> S:
        """A random first state."""
        ...

    def action_mask(self, state: S) -> Bool[Array, " A"]:
        """`[A]` bool, the actions that exist."""
        ...

    def observe(self, state: S) -> Float[Array, " S"]:
        """Input of the agent's network, `[S]`."""
        ...

    def step(
        self, key: Key, state: S, s_tm1: Float[Array, " S"], action: Int[Array, ""]
    ) -> tuple[S, Transition, Outcome]:
        """Takes an action.

        Args:
          key: random key.
          state: the current state.
          s_tm1: `[S]` what `observe` returned for it.
          action: `[]` int32.

        Returns:
          The next state, the transition to learn from and the outcome.
        """
        ...


@pytree
class MapEnvironment:
    """Environment for `train`: the map MDP of one agent.

    Attributes:
      agent: the learner.
      mdp: the MDP.
      modality: index of the agent's own sensor, see `map_mdp.step`.
      discount: `[]` discount factor of a step.
    """

    agent: Agent
    mdp: MapMdp
    modality: Index
    discount: jax.Array | float

    @property
    def num_actions(self) -> int:
        """A look at each PoI, and NOP."""
        return self.mdp.num_pois + 1

    def reset(self, key: Key) -> MapState:
        """A random first state."""
        return map_mdp.reset(key, self.mdp)

    def action_mask(self, state: MapState) -> Bool[Array, " A"]:
        """`[A]` bool: all actions exist."""
        del state
        return jnp.ones(self.num_actions, bool)

    def observe(self, state: MapState) -> Float[Array, " S"]:
        """`[N * 2D]` the map."""
        team = team_mdp.alone(self.mdp.num_pois, self.modality)
        return self.agent.observe(state.belief, team, jnp.int32(0))

    def step(
        self, key: Key, state: MapState, s_tm1: Float[Array, " S"], action: Int[Array, ""]
    ) -> tuple[MapState, Transition, Outcome]:
        """Takes an action, see `Environment.step`.

        Args:
          key: random key.
          state: the current state.
          s_tm1: `[S]` what `observe` returned for it.
          action: `[]` int32.
        """
        after, outcome = map_mdp.step(key, self.mdp, state, action, self.modality)
        discount = jnp.where(outcome.terminated, 0.0, self.discount)
        transition = Transition(s_tm1, action, outcome.reward, discount, self.observe(after))
        return after, transition, outcome


@pytree
class SmdpState:
    """State of a team, with each robot's observation and choice when it last set out.

    Attributes:
      now: the state.
      observation: `[R, S]`.
      action: `[R]` int32.
    """

    now: TeamState
    observation: jax.Array
    action: jax.Array


@pytree
class TeamEnvironment:
    """Environment for `train`: the team MDP, whose robots share one agent.

    Attributes:
      agent: the learner.
      mdp: the MDP.
      robots: `[R]` int32 index of each robot's sensor; None for a random team in each episode.
    """

    agent: Agent
    mdp: TeamMdp
    robots: jax.Array | None = None

    @property
    def num_actions(self) -> int:
        """A look at each PoI, and NOP."""
        return self.mdp.map.num_pois + 1

    def reset(self, key: Key) -> SmdpState:
        """A random first state, in which no robot has set out."""
        now = team_mdp.reset(key, self.mdp, self.robots)
        observed = self.agent.observe(now.map.belief, now.team, now.agent)
        num_robots, num_pois = len(now.team.works), self.mdp.map.num_pois
        nothing = jnp.zeros((num_robots, len(observed)))
        return SmdpState(now, nothing, jnp.full(num_robots, num_pois))

    def action_mask(self, state: SmdpState) -> Bool[Array, " A"]:
        """Mask `[A]` of the PoIs that are present, and NOP."""
        return team_mdp.action_mask(state.now)

    def observe(self, state: SmdpState) -> Float[Array, " S"]:
        """Observation `[F * N]` of the robot that chooses."""
        now = state.now
        return self.agent.observe(now.map.belief, now.team, now.agent)

    def step(
        self, key: Key, state: SmdpState, s_tm1: Float[Array, " S"], action: Int[Array, ""]
    ) -> tuple[SmdpState, Transition, Outcome]:
        """Lets one robot choose, see `Environment.step`.

        Args:
          key: random key.
          state: the current state.
          s_tm1: `[S]` what `observe` returned for it.
          action: `[]` int32.

        Returns:
          The next state; the transition of the robot that has just looked, from when it set out;
          and the outcome.
        """
        seen = state.observation.at[state.now.agent].set(s_tm1)
        chosen = state.action.at[state.now.agent].set(action)
        now, outcome = team_mdp.step(key, self.mdp, state.now, action)
        after = SmdpState(now, seen, chosen)
        # A transition is complete when a robot has looked. Otherwise emit an invalid action, whose
        # value and target are 0.
        looked = chosen[now.agent] < self.mdp.map.num_pois
        transition = Transition(
            s_tm1=seen[now.agent],
            a_tm1=jnp.where(looked, chosen[now.agent], -1),
            r_t=outcome.reward,
            discount_t=jnp.where(looked, 1.0, 0.0),
            s_t=self.observe(after),
        )
        return after, transition, outcome
