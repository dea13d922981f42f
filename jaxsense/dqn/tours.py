"""Time until the robots of a team are done after each choice, learned from simulated trials.

A discounted Q-network predicts what a look is worth but barely reflects the end of
a mission: it puts off remote PoIs, and returning to them takes long. Therefore several choices of a
robot are tried from the same state and with the same random numbers. After each, all robots follow
a given policy until they are done, and a second network learns which choice ends soonest: one step
of policy improvement by rollouts (Tesauro and Galperin 1996, On-line policy improvement using
Monte-Carlo search; Bertsekas, Tsitsiklis and Wu 1997, J. Heuristics 3, 245-262).
"""

import dataclasses
from typing import Protocol

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxsense.config.learning import ToursConfig
from jaxsense.core import networks
from jaxsense.core.networks import Params
from jaxsense.core.types import Belief, Key, pytree
from jaxsense.dqn import mdp as mdps
from jaxsense.dqn.agent import Agent
from jaxsense.dqn.mdp import Mdp, State
from jaxsense.dqn.team import TIME_SCALE
from jaxsense.dqn.training import pseudo_huber


class Policy(Protocol):
    """What all robots follow in trials.

    Reading the map takes longest, and each look changes one PoI: so a trial keeps what was read.
    """

    def read(self, belief: Belief, is_seen: Bool[Array, ""]) -> Float[Array, " G"]:
        """`[G]` what the policy reads of one PoI."""
        ...

    def values(self, read: Float[Array, "N G"], state: State) -> Float[Array, " A"]:
        """Values of actions, `[N + 1]`, NOP's last; robots take the action of the highest."""
        ...


@pytree
class _Now:
    """A state, and `[N, G]` what the policy has read of its map."""

    state: State
    read: jax.Array


BATCH = 1024
_TRIES = 4  # choices in each state
_WALK = 8  # most choices before it
_NEAR = 5.0  # s; each further one makes a trial e times as rare
_ERROR = 3.0  # s, above which an error counts linearly


@pytree
class Trials:
    """Outcomes of tried choices.

    Attributes:
      observation: `[F * N, ...]` what the robot knew.
      is_tried: `[N, ...]` bool, PoIs that it set out for; none if it had fewer than two to choose
        from.
      seconds: `[N, ...]` mean over the working robots of the time until each is done; valid where
        tried.
    """

    observation: jax.Array
    is_tried: jax.Array
    seconds: jax.Array


def try_choices(key: Key, mdp: Mdp, policy: Policy, number: int) -> Trials:
    """Tries choices in random states."""
    # Alone, all PoIs share a position, so there is no order to learn.
    assert mdp.teams is not None
    mdp = dataclasses.replace(mdp, teams=dataclasses.replace(mdp.teams, alone=0.0))
    keys = jax.random.split(key, number)
    return jax.vmap(lambda key: _trial(key, mdp, policy), out_axes=-1)(keys)


def _trial(key: Key, mdp: Mdp, policy: Policy) -> Trials:
    """The trials from one state, `[F * N]` and `[N]`."""
    start_key, walk_key, tried_key, play_key = jax.random.split(key, 4)
    first = mdps.reset(start_key, mdp)
    read = jax.vmap(policy.read)(first.belief, jnp.any(first.seen, axis=-1))
    now = _some_way_on(walk_key, mdp, policy, _Now(first, read))
    state, num_pois = now.state, mdp.num_pois
    values = policy.values(now.read, state)
    is_open = values[:-1] > values[-1]
    times = mdp.travel.times(state.team)[state.agent]
    rank = jnp.where(is_open, jax.random.gumbel(tried_key, (num_pois,)) - times / _NEAR, -jnp.inf)
    tried = jax.lax.top_k(rank, min(_TRIES, num_pois))[1]
    seconds = jax.vmap(lambda poi: _seconds_to_end(play_key, mdp, policy, now, poi))(tried)
    is_choice = jnp.sum(is_open) > 1
    return Trials(
        observation=mdp.features(state.belief, state.team, state.agent).T.reshape(-1),
        is_tried=jnp.zeros(num_pois, bool).at[tried].set(is_open[tried] & is_choice),
        seconds=jnp.zeros(num_pois).at[tried].set(seconds),
    )


def _some_way_on(key: Key, mdp: Mdp, policy: Policy, now: _Now) -> _Now:
    """Follows the policy for up to `_WALK` random choices."""
    number_key, step_key = jax.random.split(key)
    number = jax.random.randint(number_key, (), 0, _WALK + 1)

    def advance(i: jax.Array, now: _Now) -> _Now:
        after, terminated = _follow(jax.random.fold_in(step_key, i), mdp, policy, now)
        return jax.tree.map(lambda x, y: jnp.where(terminated, x, y), now, after)

    return jax.lax.fori_loop(0, number, advance, now)


def _seconds_to_end(key: Key, mdp: Mdp, policy: Policy, now: _Now, poi: jax.Array) -> jax.Array:
    """`[]` mean seconds until a working robot is done if one sets out for a PoI."""
    begin_key, step_key = jax.random.split(key)
    state = now.state
    after, _ = _step(begin_key, mdp, policy, now, poi)

    def ends_of(now: State, ends: jax.Array) -> jax.Array:
        return jnp.where(now.team.works, now.seconds, ends)

    def goes_on(carry: tuple[_Now, jax.Array, jax.Array]) -> jax.Array:
        return jnp.any(carry[0].state.team.works) & (carry[2] < mdp.config.max_steps)

    def advance(carry: tuple[_Now, jax.Array, jax.Array]):
        now, ends, i = carry
        now, _ = _follow(jax.random.fold_in(step_key, i), mdp, policy, now)
        return now, ends_of(now.state, ends), i + 1

    ends = jnp.full(state.team.works.shape, state.seconds)
    first = after, ends_of(after.state, ends), jnp.int32(0)
    _, ends, _ = jax.lax.while_loop(goes_on, advance, first)
    took = jnp.where(state.team.works, ends - state.seconds, 0.0)
    return jnp.sum(took) / jnp.maximum(jnp.sum(state.team.works), 1)


def _follow(key: Key, mdp: Mdp, policy: Policy, now: _Now) -> tuple[_Now, jax.Array]:
    """What follows the policy's choice, and `[]` bool, whether all robots are done."""
    action = jnp.argmax(policy.values(now.read, now.state)).astype(jnp.int32)
    return _step(key, mdp, policy, now, action)


def _step(
    key: Key, mdp: Mdp, policy: Policy, now: _Now, action: jax.Array
) -> tuple[_Now, jax.Array]:
    """What follows a choice, and `[]` bool, whether all robots are done."""
    after, outcome = mdps.step(key, mdp, now.state, action)
    poi = outcome.poi  # that of no look is beyond the last row
    belief = jax.tree.map(lambda x: x.at[poi].get(mode="clip"), after.belief)
    found = policy.read(belief, jnp.any(after.seen.at[poi].get(mode="clip")))
    return _Now(after, now.read.at[poi].set(found, mode="drop")), outcome.terminated


def no_trials(agent: Agent, number: int) -> Trials:
    """An empty buffer of trials."""
    num_pois = agent.num_pois
    return Trials(
        observation=jnp.zeros((agent.network.features * num_pois, number)),
        is_tried=jnp.zeros((num_pois, number), bool),
        seconds=jnp.zeros((num_pois, number)),
    )


def write(trials: Trials, found: Trials, column: Int[Array, ""]) -> Trials:
    """Writes trials into a buffer."""
    return jax.tree.map(
        lambda all, new: jax.lax.dynamic_update_slice_in_dim(all, new, column, axis=1),
        trials,
        found,
    )


def seconds(
    agent: Agent, params: Params, observation: Float[Array, "S ..."]
) -> Float[Array, "N ..."]:
    """Mean seconds until robots are done if this one sets out for each PoI, up to a constant.

    Returns:
      `[N, ...]`; only differences between PoIs that are present have a meaning.
    """
    learned = networks.apply(agent.network, params, observation)[:-1]
    return agent.seconds(observation) + TIME_SCALE * learned


@pytree
class Fitting:
    """The fit of a network to the differences between choices tried from the same state."""

    config: ToursConfig
    trials: Trials
    agent: Agent

    def draw(self, key: Key, number: int) -> Int[Array, "T B"]:
        """Draws states in which choices were tried, see `supervised.Problem.draw`."""
        counts = jnp.any(self.trials.is_tried, axis=0)
        first = jnp.argsort(~counts)
        drawn = jax.random.uniform(key, (number, min(BATCH, self.config.states))) * jnp.sum(counts)
        return first[jnp.floor(drawn).astype(jnp.int32)]

    def loss(
        self, params: Params, drawn: Int[Array, " B"], step: Int[Array, ""]
    ) -> Float[Array, ""]:
        """Mean error of a batch."""
        del step
        trials = jax.tree.map(lambda x: x[:, drawn], self.trials)
        predicted = seconds(self.agent, params, trials.observation)
        error = _differences(trials.seconds - predicted, trials.is_tried)
        number = jnp.maximum(jnp.sum(trials.is_tried), 1)
        return jnp.sum(jnp.where(trials.is_tried, pseudo_huber(error / _ERROR), 0.0)) / number


def _differences(x: jax.Array, counts: jax.Array) -> jax.Array:
    """Subtracts the mean over valid entries, `[N, ...]`."""
    number = jnp.maximum(jnp.sum(counts, axis=0), 1)
    return x - (jnp.sum(jnp.where(counts, x, 0.0), axis=0) / number)[None]
