"""The agent of a Q-network, and the environment in which it learns."""

import chex
import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, Int

from jaxsense.core import checks, networks
from jaxsense.core.networks import MLP, Params
from jaxsense.core.types import Belief, Key, Transition, pytree
from jaxsense.dqn import mdp as mdps
from jaxsense.dqn import starts
from jaxsense.dqn.mdp import Mdp, Outcome, State
from jaxsense.dqn.pooling import PoolingNetwork
from jaxsense.dqn.team import TIME_SCALE, Team, Travel, num_features, surroundings

_LEAST_DISCOUNT = 1e-30  # not 0 in float32, so that the nearer of two far looks is worth more


@pytree
class Agent:
    """A Q-network and what it observes.

    Without travel, a dense network reads the whole map, and looks take a step. With it, one network
    for any number of PoIs reads the surroundings of a robot, and time counts.

    Attributes:
      discount: `[]` discount factor of a step; with travel, of a second.
      second_cost: `[]` price of a second of travel.
      num_pois: number of PoIs; with travel, the largest that it learns with.
    """

    discount: jax.Array | float
    second_cost: jax.Array | float
    travel: Travel | None
    num_pois: int = struct.field(pytree_node=False)
    num_modalities: int = struct.field(pytree_node=False)
    latent_size: int = struct.field(pytree_node=False)
    hidden: tuple[int, ...] = struct.field(pytree_node=False)

    @property
    def network(self) -> MLP | PoolingNetwork:
        """The Q-network."""
        if self.travel is None:
            return MLP(self.hidden, self.num_pois + 1)
        return PoolingNetwork(self.hidden, num_features(self.latent_size, self.num_modalities))

    def plays(self, num_pois: int) -> bool:
        """Whether the Q-network is for this number of PoIs."""
        return self.travel is not None or num_pois == self.num_pois

    def init(self, key: Key) -> Params:
        """Random parameters of the Q-network."""
        size = 2 * self.latent_size if self.travel is None else self.network.features
        return networks.init(key, self.network, size * self.num_pois)

    def observe(
        self, belief: Belief, team: Team, times: Float[Array, "R N"], robot: Int[Array, ""]
    ) -> Float[Array, " S"]:
        """Input of the Q-network: mean and standard deviation of each PoI, PoI by PoI.

        With travel it is `[F * N]` of `surroundings`.
        """
        chex.assert_rank(belief.mean, 2)
        chex.assert_equal_shape([belief.mean, belief.std])
        checks.require_positive("belief.std", belief.std)
        if self.travel is None:
            return jnp.concatenate([belief.mean, belief.std], axis=-1).reshape(-1)
        return surroundings(belief, team, times, robot, self.num_modalities).reshape(-1)

    def q(self, params: Params, observed: Float[Array, "S ..."]) -> Float[Array, "A ..."]:
        """Values of looks, once the robot has arrived; NOP's last."""
        return networks.apply(self.network, params, observed)

    def values(
        self,
        params: Params,
        observed: Float[Array, "S ..."],
        exists: Float[Array, "N ..."] | float = 1.0,
    ) -> Float[Array, "A ..."]:
        """Values of actions as the robot sets out, by the probability that there is a PoI.

        With travel `exists discount^t q - second_cost t`, with `t` the seconds until the look. NOP
        takes none.
        """
        after = self.q(params, observed)
        of_pois = exists * after[:-1]
        if self.travel is None:
            return jnp.concatenate([of_pois, after[-1:]])
        features = num_features(self.latent_size, self.num_modalities)
        known = observed.reshape(features, -1, *observed.shape[1:])
        seconds = TIME_SCALE * known[2 * self.latent_size]
        discount = jnp.maximum(self.discount**seconds, _LEAST_DISCOUNT / (1 + seconds) ** 2)
        of_pois = discount * of_pois - self.second_cost * seconds
        return jnp.concatenate([of_pois, after[-1:]])


@pytree
class Underway:
    """A state, and each robot's last choice with the observation before it."""

    now: State
    observation: Float[Array, "R S"]
    action: Int[Array, " R"]


@pytree
class Environment:
    """What an agent learns in: an MDP, whose robots share the agent."""

    agent: Agent
    mdp: Mdp

    def reset(self, key: Key) -> Underway:
        """A random first state."""
        return self.begin(starts.reset(key, self.mdp))

    def begin(self, now: State) -> Underway:
        """A first state, in which no robot has set out."""
        num_robots, seen = len(now.team.works), self._observe(now)
        nothing = jnp.zeros((num_robots, len(seen)))
        return Underway(now, nothing, jnp.full(num_robots, self.mdp.num_pois))

    def observe(self, state: Underway) -> Float[Array, " S"]:
        """What the robot that chooses observes."""
        return self._observe(state.now)

    def step(
        self, key: Key, state: Underway, s_tm1: Float[Array, " S"], action: Int[Array, ""]
    ) -> tuple[Underway, Transition, Outcome]:
        """Lets one robot choose.

        Args:
          state: before the choice.
          s_tm1: what `observe` returned for the state.
          action: the choice.

        Returns:
          The next state; the transition of the robot that has just looked, from its last choice, or
          else of NOP, after which nothing is earned; and the outcome.
        """
        seen = state.observation.at[state.now.agent].set(s_tm1)
        chosen = state.action.at[state.now.agent].set(action)
        now, outcome = mdps.step(key, self.mdp, state.now, action)
        # The values of those who travel are discounted already.
        discount = self.agent.discount if self.agent.travel is None else 1.0
        looked = outcome.poi < self.mdp.num_pois
        transition = Transition(
            s_tm1=seen[now.agent],
            a_tm1=jnp.where(looked, chosen[now.agent], self.mdp.num_pois),
            r_t=outcome.reward,
            discount_t=jnp.where(looked, discount, 0.0),
            s_t=self._observe(now),
        )
        return Underway(now, seen, chosen), transition, outcome

    def _observe(self, state: State) -> jax.Array:
        times = self.mdp.times(state)
        return self.agent.observe(state.belief, state.team, times, state.agent)
