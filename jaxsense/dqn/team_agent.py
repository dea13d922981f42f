"""The agent of a team, one network for any number of PoIs and robots, and its environment."""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int, PyTree

from jaxsense.config.learning import TeamConfig
from jaxsense.core import networks
from jaxsense.core.networks import Params
from jaxsense.core.types import Belief, Index, Key, Transition, pytree
from jaxsense.dqn import team_mdp, tours
from jaxsense.dqn.map_mdp import MapMdp, Outcome
from jaxsense.dqn.pooling import PoolingNetwork
from jaxsense.dqn.team_mdp import Places, Team, TeamMdp, TeamState, Travel

_NOT_WORTH_IT = -1e6  # s, below minus any tour


@pytree
class TeamAgent:
    """An agent of the team MDP: one network for any number of PoIs and robots.

    Attributes:
      discount: `[]` discount factor of a second.
      useless: `[]` reward of a look that tells nothing.
      orders: whether a network orders looks, see `tours`.
    """

    config: TeamConfig
    discount: jax.Array | float
    useless: jax.Array | float
    latent_size: int = struct.field(pytree_node=False)
    num_modalities: int = struct.field(pytree_node=False)
    hidden: tuple[int, ...] = struct.field(pytree_node=False)
    orders: bool = struct.field(pytree_node=False)

    @property
    def counts_time(self) -> bool:
        """Whether values include travel time, so that no other rule needs to order looks."""
        return self.orders

    @property
    def network(self) -> PoolingNetwork:
        """The network of Q-values and of tours."""
        features = team_mdp.num_features(self.latent_size, self.num_modalities)
        return PoolingNetwork(self.hidden, features)

    @property
    def tour_networks(self) -> tuple[PoolingNetwork] | tuple[()]:
        """The network that orders looks, if any does."""
        return (self.network,) if self.orders else ()

    def learner(self, modality: str) -> str:
        """Name of what learns for robots of a modality: all robots share one network."""
        del modality
        return "team"

    def plays(self, num_pois: int) -> bool:
        """True: the Q-network is for any number of PoIs."""
        del num_pois
        return True

    def mdp(
        self, of_number: Callable[[int], MapMdp], places: Places, names: tuple[str, ...]
    ) -> TeamMdp:
        """The team MDP, from the map MDP of a number of PoIs and the names of the sensors."""
        number = self.config.num_pois[1]
        return TeamMdp(self.config, of_number(number), places, names, self._travel)

    def environment(self, mdp: PyTree, modality: Index) -> PyTree:
        """What the agent learns in, whatever its own sensor is."""
        del modality
        return TeamEnvironment(self, mdp)

    def init(self, key: Key) -> Params:
        """Random parameters of the Q-network."""
        return networks.init(key, self.network, self.network.features * self.config.num_pois[1])

    def init_tours(self, key: Key) -> tuple[Params, ...]:
        """Random parameters of `tour_networks`."""
        return tuple(self.init(key) for _ in self.tour_networks)

    def observe(self, belief: Belief, team: Team, robot: Int[Array, ""]) -> Float[Array, " S"]:
        """What a robot knows of each PoI, `[F * N]`, see `team_mdp.observation`."""
        number = self.num_modalities
        return team_mdp.observation(self._travel, belief, team, robot, number).reshape(-1)

    def q(
        self,
        params: Params,
        observed: Float[Array, "S ..."],
        others: Float[Array, "S ..."] | None = None,
    ) -> Float[Array, "A ..."]:
        """Values once the robot has arrived; NOP's last.

        Args:
          params: of the Q-network.
          observed: what the robot knows.
          others: what each PoI's value takes the other PoIs to be; as observed by default.
        """
        inputs = (observed,) if others is None else (observed, others)
        return networks.apply(self.network, params, *inputs)

    def values(self, params: Params, observed: Float[Array, "S ..."]) -> Float[Array, "A ..."]:
        """Discounts values on arrival to the time of departure.

        `discount^t q - second_cost t`, with `t` the seconds until the look. NOP takes none.
        """
        after = self.q(params, observed)
        of_pois = self.discount ** self._own_seconds(observed) * after[:-1]
        return jnp.concatenate([self._less_way(of_pois, observed), after[-1:]])

    def decide(
        self,
        params: Params,
        tour_params: tuple[Params, ...],
        classes: Belief,
        belief: Belief,
        team: Team,
        robot: Int[Array, ""],
    ) -> Float[Array, " A"]:
        """Values of a robot's actions that rank PoIs by predicted completion time.

        A look is worthwhile if its Q-value, were it the only one left, exceeds the price of the
        travel time. If no look is, judge as if the robot were alone, see `worth`: a robot that
        leaves a PoI to one that is nearer stays until that look was enough.
        The value of a worthwhile look is minus the predicted seconds of `tours`; that of NOP is
        lower, and those of other looks are lowest. Without `tour_params`, the values are those of
        `values`, and lowest for looks that are worth nothing.
        """
        seen = self.observe(belief, team, robot)
        is_useless = self.worth(params, classes, belief, team, robot) <= 0
        if not tour_params:
            values = self.values(params, seen)
            return jnp.append(jnp.where(is_useless, _NOT_WORTH_IT, values[:-1]), values[-1])
        after = self._q_alone(params, classes, belief, team, robot)
        is_own = (self._less_way(after, seen) > 0) & team.present
        is_worth_it = jnp.where(jnp.any(is_own), is_own, ~is_useless)
        seconds = tours.seconds(self.network, tour_params[0], seen, self.latent_size)
        of_pois = jnp.where(is_worth_it, -seconds, 2 * _NOT_WORTH_IT)
        # Comparisons with NaN are false; propagate it instead.
        return jnp.append(jnp.where(jnp.isnan(after), after, of_pois), _NOT_WORTH_IT)

    def worth(
        self, params: Params, classes: Belief, belief: Belief, team: Team, robot: Int[Array, ""]
    ) -> Float[Array, " N"]:
        """Value of a look at each PoI less NOP's, were no other robot at work, nor PoI left.

        Who looks is for others to say: the network would leave a PoI to a robot that is nearer.
        """
        alone = team_mdp.alone(team.present.shape[0], team.modality[robot])
        alone = dataclasses.replace(alone, present=team.present)
        after = self._q_alone(params, classes, belief, alone, jnp.int32(0))
        return self._less_way(after, self.observe(belief, team, robot))

    def _less_way(self, after: jax.Array, observed: jax.Array) -> jax.Array:
        """Values on arrival less the price of the way there, `[N, ...]`."""
        return after - self.config.second_cost * self._own_seconds(observed)

    def _q_alone(
        self, params: Params, classes: Belief, belief: Belief, team: Team, robot: Int[Array, ""]
    ) -> Float[Array, " N"]:
        """Q-value of a look at each PoI if nothing were left to learn about the others.

        The Q-value of a useless look holds what the robot can still learn elsewhere. So all other
        PoIs are shown to the network as known: as of the class that is nearest to their beliefs.
        What it then still finds in a look at a known PoI is an error, and taken off.
        """
        apart = jnp.sum((belief.mean[:, None] - classes.mean[None]) ** 2, axis=-1)
        nearest = jnp.argmin(apart, axis=-1)
        known = Belief(jnp.asarray(classes.mean)[nearest], jnp.asarray(classes.std)[nearest])
        seen, seen_known = (self.observe(x, team, robot) for x in (belief, known))
        of_look = self.q(params, seen, seen_known)[:-1]
        of_known = self.q(params, seen_known)[:-1]
        # Where there is no PoI both are far below any reward.
        return jnp.where(team.present, of_look - of_known + self.useless, of_look)

    @property
    def _travel(self) -> Travel:
        return Travel(self.config.travel.view_distance)

    def _own_seconds(self, observed: jax.Array) -> jax.Array:
        """The robot's own time to look at each PoI, `[N, ...]`."""
        features = observed.reshape(self.network.features, -1, *observed.shape[1:])
        return team_mdp.own_seconds(features, self.latent_size)


@pytree
class SmdpState:
    """State of a team, with each robot's observation and choice when it last set out."""

    now: TeamState
    observation: jax.Array
    action: jax.Array


@pytree
class TeamEnvironment:
    """Environment for `train`: the team MDP, whose robots share one agent.

    Attributes:
      robots: `[R]` int32 index of each robot's sensor; None for a random team in each episode.
    """

    agent: PyTree
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
