"""The agent of a team: one network for any number of PoIs and robots."""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, Int

from jaxsense.config import TeamConfig
from jaxsense.core import networks
from jaxsense.core.networks import Params
from jaxsense.core.types import Belief, Index, Key, pytree
from jaxsense.dqn import team_mdp, tours
from jaxsense.dqn.environments import TeamEnvironment
from jaxsense.dqn.map_mdp import MapMdp
from jaxsense.dqn.places import Places
from jaxsense.dqn.pooling import PoolingNetwork
from jaxsense.dqn.team_mdp import Names, Team, TeamMdp
from jaxsense.dqn.travel import Travel

_NOT_WORTH_IT = -1e6  # s, below minus any tour


@pytree
class TeamAgent:
    """An agent of the team MDP: one network for any number of PoIs and robots.

    Attributes:
      config: the travel model and the price of time.
      discount: `[]` discount factor of a second.
      useless: `[]` reward of a look that tells nothing.
      latent_size: D.
      num_modalities: M.
      hidden: sizes of the hidden layers.
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
        """Whether it orders looks: then no other rule needs to."""
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
        """The name of what learns for robots of a modality: all robots share one network."""
        del modality
        return "team"

    def plays(self, num_pois: int) -> bool:
        """True: the Q-network is for any number of PoIs."""
        del num_pois
        return True

    def with_discount(self, *, step: float, second: float) -> "TeamAgent":
        """The agent with another discount factor of a second, see `Agent.with_discount`.

        Args:
          step: not used.
          second: the factor.
        """
        del step
        return dataclasses.replace(self, discount=second)

    def mdp(self, of_number: Callable[[int], MapMdp], places: Places, names: Names) -> TeamMdp:
        """The team MDP.

        Args:
          of_number: number of PoIs to the map MDP.
          places: draws positions of PoIs and robots.
          names: of the sensors.
        """
        travel = Travel(self.config.travel.view_distance)
        return TeamMdp(self.config, of_number(self.config.num_pois[1]), places, names, travel)

    def environment(self, mdp: TeamMdp, modality: Index) -> TeamEnvironment:
        """What the agent learns in.

        Args:
          mdp: from `mdp`.
          modality: not used.
        """
        del modality
        return TeamEnvironment(self, mdp)

    def init(self, key: Key) -> Params:
        """Random parameters of the Q-network."""
        return networks.init(key, self.network, self.network.features * self.config.num_pois[1])

    def init_tours(self, key: Key) -> tuple[Params, ...]:
        """Random parameters of `tour_networks`."""
        return tuple(self.init(key) for _ in self.tour_networks)

    def observe(self, belief: Belief, team: Team, robot: Int[Array, ""]) -> Float[Array, " S"]:
        """What a robot knows of each PoI, see `team_mdp.observation`.

        Args:
          belief: `[N, D]` the map.
          team: robots and PoIs at this moment.
          robot: `[]` int32, the robot that chooses.
        """
        travel, number = Travel(self.config.travel.view_distance), self.num_modalities
        return team_mdp.observation(travel, belief, team, robot, number).reshape(-1)

    def q(
        self,
        params: Params,
        observed: Float[Array, "S ..."],
        others: Float[Array, "S ..."] | None = None,
    ) -> Float[Array, "A ..."]:
        """Values once the robot has arrived, see `Agent.q`.

        Args:
          params: of the Q-network.
          observed: `[F * N]`, or `[F * N, B]`.
          others: what each PoI's value takes the other PoIs to be; as observed by default.
        """
        inputs = (observed,) if others is None else (observed, others)
        return networks.apply(self.network, params, *inputs)

    def values(self, params: Params, observed: Float[Array, "S ..."]) -> Float[Array, "A ..."]:
        """Discounts values on arrival to the time of departure.

        `discount^t q - second_cost t`, with `t` the seconds until the look. NOP takes none.

        Args:
          params: of the Q-network.
          observed: `[F * N]`, or `[F * N, B]`.
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
        travel time. If none is, those are that would be if no other robot were at work, see
        `worth`: a robot that leaves a PoI to one that is nearer stays until that look was enough.
        The value of a worthwhile look is minus the predicted seconds of `tours`; that of NOP is
        lower, and those of other looks are lowest. Without `tour_params`, the values are those of
        `values`, and lowest for looks that are worth nothing.

        Args:
          params: of the Q-network.
          tour_params: of the network of `tours`, or none.
          classes: `[C, D]` joint posterior of each class.
          belief: `[N, D]` the map.
          team: robots and PoIs at this moment.
          robot: `[]` int32, the robot that chooses.
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
        self,
        params: Params,
        classes: Belief,
        belief: Belief,
        team: Team,
        robot: Int[Array, ""],
    ) -> Float[Array, " N"]:
        """What a look at each PoI is worth, see `Agent.worth`, were no other robot at work.

        Who looks is for others to say: the network would leave a PoI to a robot that is nearer.

        Args:
          params: of the Q-network.
          classes: `[C, D]` joint posterior of each class.
          belief: `[N, D]` the map.
          team: robots and PoIs at this moment.
          robot: `[]` int32, the robot that chooses.
        """
        alone = team_mdp.alone(team.present.shape[0], team.modality[robot])
        alone = dataclasses.replace(alone, present=team.present)
        after = self._q_alone(params, classes, belief, alone, jnp.int32(0))
        return self._less_way(after, self.observe(belief, team, robot))

    def _less_way(self, after: jax.Array, observed: jax.Array) -> jax.Array:
        """Values on arrival less the price of the way there, `[N, ...]`."""
        return after - self.config.second_cost * self._own_seconds(observed)

    def _q_alone(
        self,
        params: Params,
        classes: Belief,
        belief: Belief,
        team: Team,
        robot: Int[Array, ""],
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

    def _own_seconds(self, observed: jax.Array) -> jax.Array:
        """The robot's own time to look at each PoI, `[N, ...]`."""
        features = observed.reshape(self.network.features, -1, *observed.shape[1:])
        return team_mdp.own_seconds(features, self.latent_size)
