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

from jaxsense.config import ToursConfig
from jaxsense.core import networks
from jaxsense.core.networks import Params
from jaxsense.core.types import Key, pytree
from jaxsense.dqn import team_mdp
from jaxsense.dqn.losses import pseudo_huber
from jaxsense.dqn.pooling import PoolingNetwork
from jaxsense.dqn.team_mdp import TIME_SCALE, TeamMdp, TeamState

Policy = Callable[[TeamState], jax.Array]
"""`[N + 1]` values of actions, the highest of which is taken, NOP's last."""

_NEAR = 5.0  # s; each further one makes a trial e times as rare
_ERROR = 3.0  # s, above which an error counts linearly


@pytree
class Trials:
    """What has become of some choices.

    Attributes:
      observation: `[F * N, ...]` what the robot knew.
      is_tried: `[N, ...]` bool, PoIs that it set out for; none where it had fewer than two to
        choose from.
      seconds: `[N, ...]` mean over the robots at work of the time until each ends; counts where
        tried.
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
    return jax.vmap(lambda key: _trial(key, mdp, policy, config), out_axes=-1)(keys)


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
    seconds = jax.vmap(lambda poi: _seconds_to_end(play_key, mdp, policy, state, poi))(tried)
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
        after, outcome = _step(jax.random.fold_in(step_key, i), mdp, policy, state)
        return _where(outcome.terminated, state, after)

    return jax.lax.fori_loop(0, number, advance, state)


def _seconds_to_end(
    key: Key, mdp: TeamMdp, policy: Policy, state: TeamState, poi: jax.Array
) -> jax.Array:
    """`[]` seconds until a robot has ended if one sets out for a PoI, the mean of all at work."""
    begin_key, step_key = jax.random.split(key)
    after, _ = team_mdp.step(begin_key, mdp, state, poi)
    ends = jnp.full(state.team.works.shape, state.seconds)

    def goes_on(carry: tuple[TeamState, jax.Array, jax.Array]) -> jax.Array:
        return jnp.any(carry[0].team.works) & (carry[2] < mdp.config.max_steps)

    def advance(carry: tuple[TeamState, jax.Array, jax.Array]):
        now, ends, i = carry
        now, _ = _step(jax.random.fold_in(step_key, i), mdp, policy, now)
        return now, jnp.where(now.team.works, now.seconds, ends), i + 1

    first = after, jnp.where(after.team.works, after.seconds, ends), jnp.int32(0)
    _, ends, _ = jax.lax.while_loop(goes_on, advance, first)
    took = jnp.where(state.team.works, ends - state.seconds, 0.0)
    return jnp.sum(took) / jnp.maximum(jnp.sum(state.team.works), 1)


def _step(key: Key, mdp: TeamMdp, policy: Policy, state: TeamState):
    return team_mdp.step(key, mdp, state, jnp.argmax(policy(state)).astype(jnp.int32))


def _where(condition: jax.Array, ours: TeamState, theirs: TeamState) -> TeamState:
    return jax.tree.map(lambda x, y: jnp.where(condition, x, y), ours, theirs)


def no_trials(num_features: int, num_pois: int, number: int) -> Trials:
    """Room for the trials of a number of states."""
    return Trials(
        observation=jnp.zeros((num_features * num_pois, number)),
        is_tried=jnp.zeros((num_pois, number), bool),
        seconds=jnp.zeros((num_pois, number)),
    )


def write(trials: Trials, found: Trials, column: jax.Array) -> Trials:
    """Writes the trials of some states over those from a column on."""
    return jax.tree.map(
        lambda all, new: jax.lax.dynamic_update_slice_in_dim(all, new, column, axis=1),
        trials,
        found,
    )


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
