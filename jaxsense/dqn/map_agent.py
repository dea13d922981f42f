"""The agent of the map MDP, and the environment in which it learns."""

import dataclasses
from collections.abc import Callable
from typing import ClassVar

import chex
import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int, PyTree

from jaxsense.core import checks, networks
from jaxsense.core.networks import MLP, Params
from jaxsense.core.types import Belief, Index, Key, Transition, pytree
from jaxsense.dqn import map_mdp, team_mdp
from jaxsense.dqn.map_mdp import MapMdp, MapState, Outcome
from jaxsense.dqn.team_mdp import Places, Team


@pytree
class MapAgent:
    """An agent of the map MDP: a dense network for a fixed number of PoIs.

    Attributes:
      discount: `[]` discount factor of a step.
    """

    discount: jax.Array | float
    num_pois: int = struct.field(pytree_node=False)
    latent_size: int = struct.field(pytree_node=False)
    hidden: tuple[int, ...] = struct.field(pytree_node=False)
    counts_time = False
    tour_networks: ClassVar[tuple] = ()

    def learner(self, modality: str) -> str:
        """Name of what learns for robots of a modality: the modality."""
        return modality

    def plays(self, num_pois: int) -> bool:
        """Whether the Q-network is for this number of PoIs."""
        return num_pois == self.num_pois

    def mdp(
        self, of_number: Callable[[int], MapMdp], places: Places, names: tuple[str, ...]
    ) -> MapMdp:
        """The map MDP of a number of PoIs."""
        del places, names
        return of_number(self.num_pois)

    def environment(self, mdp: PyTree, modality: Index) -> PyTree:
        """What the agent learns in, with its own sensor."""
        return MapEnvironment(self, mdp, modality, self.discount)

    def init(self, key: Key) -> Params:
        """Random parameters of the Q-network."""
        return networks.init(key, self._network, 2 * self.num_pois * self.latent_size)

    def init_tours(self, key: Key) -> tuple[Params, ...]:
        """No parameters: without travel time there is no order to learn."""
        del key
        return ()

    def observe(self, belief: Belief, team: Team, robot: Int[Array, ""]) -> Float[Array, " S"]:
        """The map, see `observation`."""
        del team, robot
        return observation(belief)

    def q(self, params: Params, observed: Float[Array, "S ..."]) -> Float[Array, "A ..."]:
        """Each action's reward and the discounted best value after it; NOP's last."""
        return networks.apply(self._network, params, observed)

    def values(self, params: Params, observed: Float[Array, "S ..."]) -> Float[Array, "A ..."]:
        """The same as `q`: looks take no time."""
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
        """Values of a robot's actions in a mission.

        A PoI that is not present is shown to the network as one of a known class, about which
        nothing is left to learn. As its class is unknown, the values are means over all classes.
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
        self, params: Params, classes: Belief, belief: Belief, team: Team, robot: Int[Array, ""]
    ) -> Float[Array, " N"]:
        """Value of a look at each PoI less NOP's, if no other PoI is left.

        In a map with other open PoIs, a look that gains nothing is still worth what can be done
        after it, so each PoI is shown alone.
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
class MapEnvironment:
    """Environment for `train`: the map MDP of one agent.

    Attributes:
      modality: index of the agent's own sensor, see `map_mdp.step`.
    """

    agent: MapAgent
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
        """All actions exist."""
        del state
        return jnp.ones(self.num_actions, bool)

    def observe(self, state: MapState) -> Float[Array, " S"]:
        """The map."""
        team = team_mdp.alone(self.mdp.num_pois, self.modality)
        return self.agent.observe(state.belief, team, jnp.int32(0))

    def step(
        self, key: Key, state: MapState, s_tm1: Float[Array, " S"], action: Int[Array, ""]
    ) -> tuple[MapState, Transition, Outcome]:
        """Takes an action, see `training.Environment`."""
        after, outcome = map_mdp.step(key, self.mdp, state, action, self.modality)
        discount = jnp.where(outcome.terminated, 0.0, self.discount)
        transition = Transition(s_tm1, action, outcome.reward, discount, self.observe(after))
        return after, transition, outcome


@checks.typed
def observation(belief: Belief) -> Float[Array, " S"]:
    """Concatenates mean and standard deviation of each PoI's belief, `[N * 2D]`, PoI by PoI."""
    chex.assert_rank(belief.mean, 2)
    chex.assert_equal_shape([belief.mean, belief.std])
    checks.require_positive("belief.std", belief.std)
    return jnp.concatenate([belief.mean, belief.std], axis=-1).reshape(-1)
