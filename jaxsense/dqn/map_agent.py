"""The agent of the map MDP.

Another kind is a new class with the attributes and methods of `environments.Agent`, as `team_agent`
has one.
"""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, Int

from jaxsense.core import checks, networks
from jaxsense.core.networks import MLP, Params
from jaxsense.core.types import Belief, Index, Key, pytree
from jaxsense.dqn.environments import MapEnvironment
from jaxsense.dqn.map_mdp import MapMdp
from jaxsense.dqn.places import Places
from jaxsense.dqn.team_mdp import Names, Team


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

    def with_discount(self, *, step: float, second: float) -> "MapAgent":
        """The agent with another discount factor of a step, see `Agent.with_discount`.

        Args:
          step: the factor.
          second: not used.
        """
        del second
        return dataclasses.replace(self, discount=step)

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

        values = jnp.mean(jax.vmap(values_if)(classes), axis=0)
        return jnp.where(jnp.append(team.present, True), values, -jnp.inf)

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


@checks.typed
def observation(belief: Belief) -> Float[Array, " S"]:
    """Concatenates mean and standard deviation of each PoI's belief, `[N * 2D]`, PoI by PoI.

    Raises:
      ValueError: if a standard deviation is not positive.
    """
    checks.require_shape("belief.mean", belief.mean, (None, None))
    checks.require_shape("belief.std", belief.std, belief.mean.shape)
    checks.require_positive("belief.std", belief.std)
    return jnp.concatenate([belief.mean, belief.std], axis=-1).reshape(-1)
