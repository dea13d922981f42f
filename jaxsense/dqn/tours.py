"""How soon the robots of a team end after each choice, learned from trials in the travel model.

A discounted Q-network, see `team_mdp`, knows what a look is worth, but not the end of a mission:
it puts off PoIs that lie apart, and the way back to them is long. So some choices of a robot are
tried from the same state and with the same random numbers. After each, everybody follows a given
policy until all have ended, and a second network learns which choice ends soonest: one step of
policy improvement by rollouts (Tesauro and Galperin 1996, On-line policy improvement using
Monte-Carlo search; Bertsekas, Tsitsiklis and Wu 1997, J. Heuristics 3, 245-262).
"""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp

from jaxsense import networks
from jaxsense.config import ToursConfig
from jaxsense.dqn import team_mdp
from jaxsense.dqn.belief_mdp import Outcome
from jaxsense.dqn.losses import pseudo_huber
from jaxsense.dqn.pooling import PoolingNetwork
from jaxsense.dqn.team_mdp import TIME_SCALE, TeamMdp, TeamState
from jaxsense.networks import Params
from jaxsense.types import Key, pytree

Policy = Callable[[TeamState], jax.Array]
"""`[N + 1]` values of actions, the highest of which is taken, NOP's last."""

_AT_ONCE = 4096  # states, of which trials are made side by side
_NEAR = 5.0  # s; each further one makes a trial e times as rare
_ERROR = 3.0  # s, above which an error counts linearly


@pytree
class Trials:
    """What has become of some choices.

    Attributes:
      observation: `[F * N, ...]` what the robot knew.
      is_tried: `[N, ...]` bool, PoIs that it set out for; none where it had fewer than two to
        choose from.
      seconds: `[N, ...]` until robots have ended, see `ToursConfig.last_end`; counts where tried.
    """

    observation: jax.Array
    is_tried: jax.Array
    seconds: jax.Array


def try_choices(key: Key, mdp: TeamMdp, policy: Policy, config: ToursConfig, number: int) -> Trials:
    """Tries choices in random states.

    Args:
      key: random key.
      mdp: the MDP.
      policy: what everybody follows after the choice, and before it.
      config: how many choices, and how far from a start.
      number: B, of states.

    Returns:
      `[..., B]` trials.
    """
    # All that a lone robot looks at is at one place: no order to learn.
    mdp = dataclasses.replace(mdp, config=dataclasses.replace(mdp.config, alone=0.0))
    keys = jax.random.split(key, number)
    # In parts of the same size: a remainder would compile again.
    parts = -(-number // _AT_ONCE)
    rows = jnp.arange(parts * -(-number // parts)).reshape(parts, -1) % number
    try_one = jax.vmap(lambda key: _trial(key, mdp, policy, config))
    found = jax.lax.map(lambda rows: try_one(keys[rows]), rows)
    return jax.tree.map(lambda x: jnp.moveaxis(x.reshape(-1, *x.shape[2:])[:number], 0, -1), found)


def _trial(key: Key, mdp: TeamMdp, policy: Policy, config: ToursConfig) -> Trials:
    """The trials from one state, `[F * N]` and `[N]`."""
    start_key, walk_key, tried_key, play_key = jax.random.split(key, 4)
    state = _some_way_on(walk_key, mdp, policy, config, team_mdp.reset(start_key, mdp))
    values, num_pois = policy(state), mdp.map.num_pois
    is_open = values[:-1] > values[-1]
    travel = mdp.config.travel
    pose = state.team.poses[state.agent]
    times = team_mdp.travel_seconds(travel, pose, state.team.positions)
    rank = jnp.where(is_open, jax.random.gumbel(tried_key, (num_pois,)) - times / _NEAR, -jnp.inf)
    tried = jax.lax.top_k(rank, min(config.tries, num_pois))[1]
    given = mdp, policy, config, state
    seconds = jax.vmap(lambda poi: _seconds_to_end(play_key, *given, poi))(tried)
    is_choice = jnp.sum(is_open) > 1
    known = state.map.belief, state.team, state.agent, mdp.map.num_modalities
    return Trials(
        observation=team_mdp.observation(travel, *known).reshape(-1),
        is_tried=jnp.zeros(num_pois, bool).at[tried].set(is_open[tried] & is_choice),
        seconds=jnp.zeros(num_pois).at[tried].set(seconds),
    )


def _some_way_on(
    key: Key, mdp: TeamMdp, policy: Policy, config: ToursConfig, state: TeamState
) -> TeamState:
    """A state up to `config.walk` choices later, in which a robot chooses."""
    number_key, step_key = jax.random.split(key)
    number = jax.random.randint(number_key, (), 0, config.walk + 1)

    def advance(i: jax.Array, state: TeamState) -> TeamState:
        after, outcome = _step(jax.random.fold_in(step_key, i), mdp, state, _best(policy, state))
        return _where(outcome.terminated, state, after)

    return jax.lax.fori_loop(0, number, advance, state)


def _seconds_to_end(
    key: Key,
    mdp: TeamMdp,
    policy: Policy,
    config: ToursConfig,
    state: TeamState,
    poi: jax.Array,
) -> jax.Array:
    """`[]` seconds until robots have ended if one sets out for a PoI, see `ToursConfig.last_end`.

    That robot does not change its mind before it has looked; the others may.
    """
    begin_key, step_key = jax.random.split(key)
    is_chooser = jnp.arange(state.team.works.shape[0]) == state.agent

    def step(key: Key, now: TeamState, action: jax.Array) -> TeamState:
        after, _ = _step(key, mdp, now, action)
        keeps = is_chooser & (after.team.target == poi)
        return dataclasses.replace(after, asks=after.asks & ~keeps)

    def goes_on(carry: tuple[TeamState, jax.Array, jax.Array]) -> jax.Array:
        return jnp.any(carry[0].team.works) & (carry[2] < mdp.config.max_steps)

    def advance(carry: tuple[TeamState, jax.Array, jax.Array]):
        now, ends, i = carry
        now = step(jax.random.fold_in(step_key, i), now, _best(policy, now))
        return now, jnp.where(now.team.works, now.seconds, ends), i + 1

    after = step(begin_key, state, poi)
    first = after, jnp.full(is_chooser.shape, after.seconds), jnp.int32(0)
    _, ends, _ = jax.lax.while_loop(goes_on, advance, first)
    took = jnp.where(state.team.works, ends - state.seconds, 0.0)
    mean = jnp.sum(took) / jnp.maximum(jnp.sum(state.team.works), 1)
    return config.last_end * jnp.max(took) + (1.0 - config.last_end) * mean


def _step(key: Key, mdp: TeamMdp, state: TeamState, action: jax.Array) -> tuple[TeamState, Outcome]:
    """`team_mdp.step`; a look is news, after which robots under way choose anew, as in missions."""
    after, outcome = team_mdp.step(key, mdp, state, action)
    is_news = after.seconds > state.seconds
    is_under_way = after.team.works & (after.looked <= 0)
    return dataclasses.replace(after, asks=after.asks | (is_news & is_under_way)), outcome


def _best(policy: Policy, state: TeamState) -> jax.Array:
    return jnp.argmax(policy(state)).astype(jnp.int32)


def _where(condition: jax.Array, ours: TeamState, theirs: TeamState) -> TeamState:
    return jax.tree.map(lambda x, y: jnp.where(condition, x, y), ours, theirs)


def sample(key: Key, trials: Trials, shape: tuple[int, ...]) -> jax.Array:
    """Random columns, int32, of states in which something was tried."""
    counts = jnp.any(trials.is_tried, axis=0)
    first = jnp.argsort(~counts)
    drawn = jnp.floor(jax.random.uniform(key, shape) * jnp.sum(counts))
    return first[drawn.astype(jnp.int32)]


def seconds(
    network: PoolingNetwork, params: Params, observation: jax.Array, latent_size: int
) -> jax.Array:
    """Seconds until robots end, on average, if this one sets out for each PoI; up to a constant.

    Args:
      network: of a team.
      params: its parameters.
      observation: `[F * N, ...]` what the robot knows.
      latent_size: D.

    Returns:
      `[N, ...]`; only differences mean anything, and those to absent PoIs nothing.
    """
    learned = networks.apply(network, params, observation)[:-1]
    observed = observation.reshape(network.features, *learned.shape)
    return team_mdp.own_seconds(observed, latent_size) + TIME_SCALE * learned


def loss(network: PoolingNetwork, params: Params, trials: Trials, latent_size: int) -> jax.Array:
    """`[]` mean error of the differences between the choices tried from the same state."""
    predicted = seconds(network, params, trials.observation, latent_size)
    error = _differences(trials.seconds - predicted, trials.is_tried)
    number = jnp.maximum(jnp.sum(trials.is_tried), 1)
    return jnp.sum(jnp.where(trials.is_tried, pseudo_huber(error / _ERROR), 0.0)) / number


def _differences(x: jax.Array, counts: jax.Array) -> jax.Array:
    """`[N, ...]` less the mean of those that count."""
    number = jnp.maximum(jnp.sum(counts, axis=0), 1)
    return x - (jnp.sum(jnp.where(counts, x, 0.0), axis=0) / number)[None]
