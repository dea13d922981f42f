"""Agents: how a Q-network is used, for the map MDP and for a team.

Another kind is a new class with the attributes and methods of `environments.Agent`.
"""

import dataclasses
from collections.abc import Callable

import chex
import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, Int

from jaxsense.config import TeamConfig
from jaxsense.core import checks, networks
from jaxsense.core.networks import MLP, Params
from jaxsense.core.types import Belief, Index, Key, pytree
from jaxsense.dqn import team_mdp, tours
from jaxsense.dqn.environments import MapEnvironment, TeamEnvironment
from jaxsense.dqn.map_mdp import MapMdp
from jaxsense.dqn.places import Places
from jaxsense.dqn.pooling import PoolingNetwork
from jaxsense.dqn.team_mdp import Names, Team, TeamMdp

_NOT_WORTH_IT = -1e6  # s, below minus any tour


@pytree
class MapAgent:
    """An agent of the map MDP: a dense network for a fixed number of PoIs.

    Attributes:
      discount: `[]` discount factor of a step.
      num_pois: N.
      latent_size: D.
      hidden: sizes of the hidden layers.
    """

    discount: jax.Array | float
    num_pois: int = struct.field(pytree_node=False)
    latent_size: int = struct.field(pytree_node=False)
    hidden: tuple[int, ...] = struct.field(pytree_node=False)

    @property
    def counts_time(self) -> bool:
        """False: looks take no time in the map MDP."""
        return False

    @property
    def tour_networks(self) -> tuple[()]:
        """None: without travel time there is no order to learn."""
        return ()

    def learner(self, modality: str) -> str:
        """The name of what learns for robots of a modality: the modality."""
        return modality

    def plays(self, num_pois: int) -> bool:
        """Whether the Q-network is for this number of PoIs."""
        return num_pois == self.num_pois

    def mdp(self, of_number: Callable[[int], MapMdp], places: Places, names: Names) -> MapMdp:
        """The map MDP.

        Args:
          of_number: number of PoIs to the map MDP.
          places: not used.
          names: not used.
        """
        del places, names
        return of_number(self.num_pois)

    def environment(self, mdp: MapMdp, modality: Index) -> MapEnvironment:
        """What the agent learns in.

        Args:
          mdp: from `mdp`.
          modality: index of the agent's own sensor.
        """
        return MapEnvironment(self, mdp, modality, self.discount)

    @property
    def num_inputs(self) -> int:
        """S, the size of what `observe` returns."""
        return 2 * self.num_pois * self.latent_size

    def init(self, key: Key) -> Params:
        """Random parameters of the Q-network."""
        return networks.init(key, self._network, self.num_inputs)

    def init_tours(self, key: Key) -> tuple[()]:
        """None, see `tour_networks`."""
        del key
        return ()

    def team_inputs(self, num_pois: int, num_robots: int) -> dict[str, jax.ShapeDtypeStruct]:
        """None: the map says everything.

        Args:
          num_pois: not used.
          num_robots: not used.
        """
        del num_pois, num_robots
        return {}

    def observe(self, belief: Belief, team: Team, robot: Int[Array, ""]) -> Float[Array, " S"]:
        """The map, see `observation`.

        Args:
          belief: `[N, D]` the map.
          team: not used.
          robot: not used.
        """
        del team, robot
        return observation(belief)

    def q(self, params: Params, observed: Float[Array, "S ..."]) -> Float[Array, "A ..."]:
        """The network's output, see `Agent.q`.

        Args:
          params: of the Q-network.
          observed: `[N * 2D]`, or `[N * 2D, B]`.
        """
        return networks.apply(self._network, params, observed)

    def values(self, params: Params, observed: Float[Array, "S ..."]) -> Float[Array, "A ..."]:
        """The same as `q`: looks take no time.

        Args:
          params: of the Q-network.
          observed: `[N * 2D]`, or `[N * 2D, B]`.
        """
        return self.q(params, observed)

    def decide(
        self,
        params: Params,
        tour_params: tuple[Params, ...],
        classes: Belief,
        belief: Belief,
        team: Team,
        robot: Int[Array, ""],
    ) -> Float[Array, " A"]:
        """Values of a robot's actions in a mission, see `Agent.decide`.

        A PoI that is not present is shown to the network as one of a known class, about which
        nothing is left to learn. As its class is unknown, the values are means over all classes.

        Args:
          params: of the Q-network.
          tour_params: not used.
          classes: `[C, D]` joint posterior of each class.
          belief: `[N, D]` the map.
          team: which PoIs are present.
          robot: not used.
        """
        del tour_params

        def values_if(known: Belief) -> jax.Array:
            seen = jax.tree.map(
                lambda own, known: jnp.where(team.present[:, None], own, known[None]),
                belief,
                known,
            )
            return self.values(params, self.observe(seen, team, robot))

        return jnp.mean(jax.vmap(values_if)(classes), axis=0)

    def worth(
        self,
        params: Params,
        classes: Belief,
        belief: Belief,
        team: Team,
        robot: Int[Array, ""],
    ) -> Float[Array, " N"]:
        """What a look at each PoI is worth, see `Agent.worth`.

        In a map with other open PoIs, a look that gains nothing is still worth what can be done
        after it, so each PoI is shown alone.

        Args:
          params: of the Q-network.
          classes: `[C, D]` joint posterior of each class.
          belief: `[N, D]` the map.
          team: which PoIs are present.
          robot: not used.
        """

        def of_poi(poi: Int[Array, ""]) -> jax.Array:
            only = team.present & (jnp.arange(self.num_pois) == poi)
            alone = dataclasses.replace(team, present=only)
            values = self.decide(params, (), classes, belief, alone, robot)
            return values[poi] - values[-1]

        return jax.vmap(of_poi)(jnp.arange(self.num_pois))

    @property
    def _network(self) -> MLP:
        return MLP(self.hidden, self.num_pois + 1)


@pytree
class TeamAgent:
    """An agent of the team MDP: one network for any number of PoIs and robots.

    Attributes:
      config: the travel model and the price of time.
      discount: `[]` discount factor of a second.
      latent_size: D.
      num_modalities: M.
      hidden: sizes of the hidden layers.
    """

    config: TeamConfig
    discount: jax.Array | float
    latent_size: int = struct.field(pytree_node=False)
    num_modalities: int = struct.field(pytree_node=False)
    hidden: tuple[int, ...] = struct.field(pytree_node=False)

    @property
    def counts_time(self) -> bool:
        """True: driving takes time in the team MDP."""
        return True

    @property
    def network(self) -> PoolingNetwork:
        """The network of Q-values and of tours."""
        features = team_mdp.num_features(self.latent_size, self.num_modalities)
        return PoolingNetwork(self.hidden, features)

    @property
    def tour_networks(self) -> tuple[PoolingNetwork]:
        """The network that orders looks."""
        return (self.network,)

    def learner(self, modality: str) -> str:
        """The name of what learns for robots of a modality: all robots share one network."""
        del modality
        return "team"

    def plays(self, num_pois: int) -> bool:
        """True: the Q-network is for any number of PoIs."""
        del num_pois
        return True

    def mdp(self, of_number: Callable[[int], MapMdp], places: Places, names: Names) -> TeamMdp:
        """The team MDP.

        Args:
          of_number: number of PoIs to the map MDP.
          places: draws positions of PoIs and robots.
          names: of the sensors.
        """
        return TeamMdp(self.config, of_number(self.config.num_pois[1]), places, names)

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

    def init_tours(self, key: Key) -> tuple[Params]:
        """Random parameters of the network that orders looks, see `tours`."""
        return (self.init(key),)

    def team_inputs(self, num_pois: int, num_robots: int) -> dict[str, jax.ShapeDtypeStruct]:
        """All fields of `Team`, and the index of the robot that chooses.

        Args:
          num_pois: N.
          num_robots: R.
        """
        struct_of = jax.ShapeDtypeStruct
        return {
            "positions": struct_of((num_pois, 2), jnp.float32),
            "present": struct_of((num_pois,), bool),
            "poses": struct_of((num_robots, 3), jnp.float32),
            "modality": struct_of((num_robots,), jnp.int32),
            "works": struct_of((num_robots,), bool),
            "target": struct_of((num_robots,), jnp.int32),
            "robot": struct_of((), jnp.int32),
        }

    def observe(self, belief: Belief, team: Team, robot: Int[Array, ""]) -> Float[Array, " S"]:
        """What a robot knows of each PoI, see `team_mdp.observation`.

        Args:
          belief: `[N, D]` the map.
          team: robots and PoIs at this moment.
          robot: `[]` int32, the robot that chooses.
        """
        travel, number = self.config.travel, self.num_modalities
        return team_mdp.observation(travel, belief, team, robot, number).reshape(-1)

    def q(self, params: Params, observed: Float[Array, "S ..."]) -> Float[Array, "A ..."]:
        """Values once the robot has arrived, see `Agent.q`.

        Args:
          params: of the Q-network.
          observed: `[F * N]`, or `[F * N, B]`.
        """
        return networks.apply(self.network, params, observed)

    def values(self, params: Params, observed: Float[Array, "S ..."]) -> Float[Array, "A ..."]:
        """Discounts values on arrival to the time of departure.

        `discount^t q - second_cost t`, with `t` the seconds until the look. NOP takes none.

        Args:
          params: of the Q-network.
          observed: `[F * N]`, or `[F * N, B]`.
        """
        after = self.q(params, observed)
        seconds = self._own_seconds(observed)
        of_pois = self.discount**seconds * after[:-1] - self.config.second_cost * seconds
        return jnp.concatenate([of_pois, after[-1:]])

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

        A look is worthwhile if its Q-value exceeds the price of the travel time. Its value is then
        minus the predicted seconds of `tours`; that of NOP is lower, and those of other looks are
        lowest. Without `tour_params`, the values are those of `values`.

        Args:
          params: of the Q-network.
          tour_params: of the network of `tours`, or none.
          classes: not used.
          belief: `[N, D]` the map.
          team: robots and PoIs at this moment.
          robot: `[]` int32, the robot that chooses.
        """
        del classes
        seen = self.observe(belief, team, robot)
        if not tour_params:
            return self.values(params, seen)
        after = self.q(params, seen)[:-1]
        is_worth_it = after > self.config.second_cost * self._own_seconds(seen)
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
        """What a look at each PoI is worth, see `Agent.worth`.

        Args:
          params: of the Q-network.
          classes: not used.
          belief: `[N, D]` the map.
          team: robots and PoIs at this moment.
          robot: `[]` int32, the robot that chooses.
        """
        del classes
        values = self.values(params, self.observe(belief, team, robot))
        return values[:-1] - values[-1]

    def _own_seconds(self, observed: jax.Array) -> jax.Array:
        """The robot's own time to look at each PoI, `[N, ...]`."""
        features = observed.reshape(self.network.features, -1, *observed.shape[1:])
        return team_mdp.own_seconds(features, self.latent_size)


def observation(belief: Belief) -> Float[Array, " S"]:
    """Mean and standard deviation of each PoI's belief, `[N * 2D]`, PoI by PoI.

    Raises:
      ValueError: if a standard deviation is not positive.
    """
    chex.assert_rank(belief.mean, 2, custom_message="belief.mean")
    chex.assert_shape(belief.std, belief.mean.shape, custom_message="belief.std")
    checks.require_positive("belief.std", belief.std)
    return jnp.concatenate([belief.mean, belief.std], axis=-1).reshape(-1)
