"""Policies: the DQN's and its baselines. Each is `(key, state) -> action`."""

import math
from collections.abc import Callable

import chex
import jax
import jax.numpy as jnp

from jaxsense.config import DqnConfig, TeamConfig
from jaxsense.core import checks, networks
from jaxsense.core.networks import MLP, Params
from jaxsense.core.types import Belief, Index, Key
from jaxsense.dqn import belief_mdp, optimum, team_mdp, tours
from jaxsense.dqn.belief_mdp import MapMdp, MapState
from jaxsense.dqn.pooling import PoolingNetwork
from jaxsense.dqn.team_mdp import Team

Policy = Callable[[Key, MapState], jax.Array]

_NOT_WORTH = -1e6  # s, below minus any tour


def q_network(num_pois: int, hidden: tuple[int, ...]) -> MLP:
    """The Q-network: `[N * 2D]` map to `[N + 1]` values, NOP's last."""
    return MLP(hidden, num_pois + 1)


def team_network(latent_size: int, num_modalities: int, config: DqnConfig) -> PoolingNetwork:
    """The Q-network of a team, for any number of PoIs."""
    return PoolingNetwork(config.hidden, team_mdp.num_features(latent_size, num_modalities))


def greedy(mdp: MapMdp, params: Params, hidden: tuple[int, ...]) -> Policy:
    """Takes a Q-network's best action, or -1, whose reward is NaN, if a value is NaN."""

    def act(key: Key, state: MapState) -> jax.Array:
        del key
        seen = belief_mdp.observation(state.belief)
        return _best(networks.apply(q_network(mdp.num_pois, hidden), params, seen))

    return act


def greedy_alone(
    mdp: MapMdp, params: Params, modality: Index, team: TeamConfig, config: DqnConfig
) -> Policy:
    """Takes the best action of a team's Q-network for one robot that is alone, see `greedy`.

    All is at one place, and so there is no order to choose, see `tours`.
    """
    latent_size = mdp.unseen.mean.shape[0]
    network = team_network(latent_size, mdp.num_modalities, config)

    def act(key: Key, state: MapState) -> jax.Array:
        del key
        alone = team_mdp.alone(mdp.num_pois, jnp.asarray(modality))
        known = state.belief, alone, jnp.int32(0), mdp.num_modalities
        seen = team_mdp.observation(team.travel, *known).reshape(-1)
        after = networks.apply(network, params, seen)
        return _best(of_ways(after, seen, latent_size, team, config))

    return act


def tour_values(
    params: Params,
    tour_params: Params,
    belief: Belief,
    team: Team,
    agent: jax.Array,
    num_modalities: int,
    config: TeamConfig,
    dqn: DqnConfig,
) -> jax.Array:
    """Values of a robot's actions, `[N + 1]`, in the order that ends the team's work soonest.

    A look is worth it if its reward and what follows, as the Q-network predicts them, exceed the
    price of the way. The value is then minus the predicted seconds of `tours`; that of NOP lies
    below these, and those of other looks lowest.

    Args:
      params: of the Q-network.
      tour_params: of the network of `tours`.
      belief: `[N, D]` the map.
      team: where everybody is.
      agent: `[]` int32, the robot that chooses.
      num_modalities: M.
      config: the price of time and the model of travel.
      dqn: the sizes of both networks.
    """
    latent_size = belief.mean.shape[1]
    network = team_network(latent_size, num_modalities, dqn)
    observed = team_mdp.observation(config.travel, belief, team, agent, num_modalities)
    seen = observed.reshape(-1)
    after = networks.apply(network, params, seen)[:-1]
    is_worth_it = after > config.second_cost * team_mdp.own_seconds(observed, latent_size)
    seconds = tours.seconds(network, tour_params, seen, latent_size)
    of_pois = jnp.where(is_worth_it, -seconds, 2 * _NOT_WORTH)
    # NaN is worth nothing in a comparison, but must not pass for a decision.
    return jnp.append(jnp.where(jnp.isnan(after), after, of_pois), _NOT_WORTH)


def of_ways(
    after: jax.Array, seen: jax.Array, latent_size: int, config: TeamConfig, dqn: DqnConfig
) -> jax.Array:
    """Values of setting out for PoIs now, from the values when a robot has arrived there.

    Until then time passes: `discount^t after - second_cost t`, with `t` the seconds of the way. NOP
    takes none.

    Args:
      after: `[N + 1, ...]` rewards of the looks and best values after them; 0 for NOP.
      seen: `[F * N, ...]` observation.
      latent_size: D.
      config: the price of time.
      dqn: the discount of a second.
    """
    num_pois = after.shape[0] - 1
    observed = seen.reshape(-1, num_pois, *seen.shape[1:])
    seconds = team_mdp.own_seconds(observed, latent_size)
    of_pois = dqn.discount**seconds * after[:-1] - config.second_cost * seconds
    return jnp.concatenate([of_pois, after[-1:]])


def random(mdp: MapMdp) -> Policy:
    """Takes every action with equal chance."""
    return lambda key, state: jax.random.randint(key, (), 0, mdp.num_pois + 1)


def naive(mdp: MapMdp, modality: Index) -> Policy:
    """Explores naively: the first PoI that the own sensor has not seen; NOP after the last."""
    checks.require_index("modality", modality, mdp.num_modalities)

    def act(key: Key, state: MapState) -> jax.Array:
        del key
        own = state.seen[:, modality]
        return jnp.where(jnp.all(own), mdp.num_pois, jnp.argmin(own))

    return act


def expected_rewards(key: Key, mdp: MapMdp, modality: Index, num_draws: int) -> jax.Array:
    """Expected reward of a look, by class and earlier looks.

    Args:
      key: random key.
      mdp: the MDP.
      modality: index of the agent's own sensor, see `belief_mdp.step`.
      num_draws: simulated looks for each entry of the table.

    Returns:
      `[2^M, C]` mean reward of looking at a PoI of class c after looks by the modalities m whose
      bits m are set in the first index.
    """

    def reward(key: Key, code: jax.Array, poi_class: jax.Array) -> jax.Array:
        reset_key, look_key = jax.random.split(key)
        bits = (code >> jnp.arange(mdp.num_modalities) & 1).astype(bool)
        seen = jnp.broadcast_to(bits, (mdp.num_pois, mdp.num_modalities))
        classes = jnp.full(mdp.num_pois, poi_class)
        state = belief_mdp.reset(reset_key, mdp, classes, seen)
        return belief_mdp.step(look_key, mdp, state, jnp.int32(0), modality)[1].reward

    # In one batch: one `vmap` in another takes three times as long to compile.
    shape = (2**mdp.num_modalities, mdp.num_classes, num_draws)
    codes, classes, _ = jnp.unravel_index(jnp.arange(math.prod(shape)), shape)
    rewards = jax.vmap(reward)(jax.random.split(key, math.prod(shape)), codes, classes)
    return rewards.reshape(shape).mean(axis=-1)


def optimal(mdp: MapMdp, rewards: jax.Array, label_of_class: jax.Array) -> Policy:
    """Acts greedily on the true expected reward, given what the looks so far can reveal.

    Optimal for the total reward, because PoIs are independent: every look that pays is worth taking
    and the order is free. It knows which looks were taken and their noise-free results, not the
    noise of single detections.

    Args:
      mdp: the MDP.
      rewards: `[2^M, C]` from `expected_rewards`, for the agent's own modality.
      label_of_class: `[M, C]` int32, label that each modality detects for each class. Classes whose
        labels match the true one's in all modalities that have looked are equally likely.

    Returns:
      The policy; it uses the hidden parts of the state. Its action is -1 if a reward is NaN.
    """
    shape = (mdp.num_modalities, mdp.num_classes)
    chex.assert_shape(label_of_class, shape, custom_message="label_of_class")
    chex.assert_shape(rewards, (2 ** shape[0], shape[1]), custom_message="rewards")
    checks.require_finite("rewards", rewards)

    def of_poi(seen: jax.Array, poi_class: jax.Array) -> jax.Array:
        is_same = label_of_class == label_of_class[:, poi_class][:, None]
        is_open = jnp.all(is_same | ~seen[:, None], axis=0)
        code = jnp.sum(seen << jnp.arange(mdp.num_modalities))
        return jnp.sum(rewards[code] * is_open) / jnp.sum(is_open)

    def act(key: Key, state: MapState) -> jax.Array:
        del key
        return _best(jnp.append(jax.vmap(of_poi)(state.seen, state.classes), 0.0))

    return act


def by_posterior(
    table: jax.Array, first: jax.Array, weights: Callable[[Belief], jax.Array]
) -> Policy:
    """Takes the look of the highest value, by what the map shows; NOP if none is above 0.

    Args:
      table: `[P]` values of a look, one of `optimum.LookValues`: with `total` the optimal policy,
        with `gain` one that does not look ahead.
      first: `[]` value of a look at an unseen PoI, `first_total` or `first_gain`.
      weights: `belief [D] -> [C]`, the classes' probabilities that an entry of the map holds.
    """

    def of_poi(belief: Belief, seen: jax.Array) -> jax.Array:
        return jnp.where(jnp.any(seen), optimum.interpolate(table, weights(belief)), first)

    def act(key: Key, state: MapState) -> jax.Array:
        del key
        return _best(jnp.append(jax.vmap(of_poi)(state.belief, state.seen), 0.0))

    return act


def _best(values: jax.Array) -> jax.Array:
    """Action, `[]` int32, of the highest of `[N + 1]` values; -1, which is none, if one is NaN."""
    return jnp.where(jnp.any(jnp.isnan(values)), -1, jnp.argmax(values))
