"""Whole episodes of policies, from random starts and from every state of the map."""

import itertools
import random
from collections.abc import Callable
from typing import Protocol, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

from jaxsense.core.types import Index, Key, call, pytree
from jaxsense.dqn import map_mdp, team_mdp
from jaxsense.dqn.map_mdp import MapMdp, MapState
from jaxsense.dqn.policies import Known
from jaxsense.dqn.team_mdp import TeamMdp, TeamState, alone

M = TypeVar("M")

MAX_STATES = 4096


class LogLikelihoods(Protocol):
    """How the exact Bayes filter reads a look; see `vae.bayes.Bayes`."""

    def log_likelihoods(self, features: Float[Array, " L"], modality: int) -> Float[Array, " C"]:
        """Log-likelihood of each class given one look.

        Args:
          features: `[D_m]` probabilities of the labels.
          modality: index of the sensor; static.
        """
        ...


@pytree
class Start:
    """The first state of an episode, and what policies know besides.

    Attributes:
      state: the state.
      log_likelihood: `[N, C]` logarithms of the classes' likelihoods given all earlier looks.
    """

    state: MapState
    log_likelihood: jax.Array


def reset(
    key: Key,
    mdp: MapMdp,
    exact: LogLikelihoods,
    classes: Int[Array, " N"] | None = None,
    seen: Bool[Array, "N M"] | None = None,
) -> Start:
    """Starts an episode, see `map_mdp.reset`.

    Args:
      key: random key.
      mdp: the MDP.
      exact: the exact Bayes filter.
      classes: see `map_mdp.reset`.
      seen: see `map_mdp.reset`.
    """
    state, looks = map_mdp.reset_with_looks(key, mdp, classes, seen)
    total = jnp.zeros((mdp.num_pois, mdp.num_classes))
    for m, features in enumerate(looks):
        of_pois = jax.vmap(lambda x: exact.log_likelihoods(x, m))(features)  # noqa: B023
        total += jnp.where(state.seen[:, m : m + 1], of_pois, 0.0)
    return Start(state, total)


def run_episode(
    key: Key,
    mdp: MapMdp,
    exact: LogLikelihoods,
    act: Callable[[Key, Known], jax.Array],
    start: Start,
    modality: Index,
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Plays one episode with a policy.

    With the same key, the k-th look at a PoI shows the same whatever came before, so that policies
    are compared on the same looks. Under `vmap` it runs until the longest episode has ended.

    Args:
      key: random key.
      mdp: the MDP.
      exact: the exact Bayes filter, whose posterior some policies read.
      act: `(key, known) -> []` int32 action, see `policies.best`.
      start: from `reset`.
      modality: index of the agent's own sensor, see `map_mdp.step`.

    Returns:
      `[]` total reward, without discount, and `[]` reward of the first action.
    """

    def act_alike(key: Key, known: Known, memory: tuple[()]) -> tuple[jax.Array, tuple[()]]:
        return act(key, known), memory

    return run_recurrent(key, mdp, exact, act_alike, (), start, modality)


def run_recurrent(
    key: Key,
    mdp: MapMdp,
    exact: LogLikelihoods,
    act: Callable[[Key, Known, M], tuple[jax.Array, M]],
    memory: M,
    start: Start,
    modality: Index,
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Plays one episode with a policy that remembers, see `run_episode`.

    Args:
      key: random key.
      mdp: the MDP.
      exact: the exact Bayes filter.
      act: `(key, known, memory) -> []` int32 action, and the memory after it.
      memory: before the first action.
      start: from `reset`.
      modality: index of the agent's own sensor.

    Returns:
      See `run_episode`.
    """
    num_pois, team = mdp.num_pois, alone(mdp.num_pois, modality)
    times = jnp.ones((1, num_pois))
    policy_key, looks_key = jax.random.split(key)

    def play(carry: _Carry) -> _Carry:
        state, looks = carry.state, carry.looks
        known = Known(
            state.belief,
            looks[:num_pois],
            jax.nn.log_softmax(carry.log_likelihood),
            team,
            times,
            jnp.int32(0),
        )
        policy = jax.random.fold_in(policy_key, state.steps)
        action, memory = act(policy, known, carry.memory)
        own = carry.own_looks[action]
        look_key = jax.random.fold_in(jax.random.fold_in(looks_key, action), own)
        poi = jnp.minimum(action, num_pois - 1)

        def of_look(m: int) -> jax.Array:
            # The same key yields the same look as in the step.
            features, _ = mdp.looks.observe(look_key, state.scene, poi, m)
            return exact.log_likelihoods(features, m)

        found = jnp.where(action < num_pois, call(of_look, modality, mdp.num_modalities), 0.0)
        after, outcome = map_mdp.step(look_key, mdp, state, action, modality)
        is_first = state.steps == start.state.steps
        return _Carry(
            state=after,
            looks=looks.at[action, modality].add(1),
            own_looks=carry.own_looks.at[action].add(1),
            log_likelihood=carry.log_likelihood.at[poi].add(found),
            memory=memory,
            done=outcome.terminated | outcome.truncated,
            total=carry.total + outcome.reward,
            first=jnp.where(is_first, outcome.reward, carry.first),
        )

    looks = jnp.concatenate([start.state.seen, jnp.zeros((1, mdp.num_modalities), bool)])
    carry = _Carry(
        state=start.state,
        looks=looks.astype(jnp.int32),
        own_looks=jnp.zeros(num_pois + 1, jnp.int32),
        log_likelihood=start.log_likelihood,
        memory=memory,
        done=jnp.bool_(False),
        total=jnp.float32(0.0),
        first=jnp.float32(0.0),
    )
    end = jax.lax.while_loop(lambda carry: ~carry.done, play, carry)
    return end.total, end.first


def run_team(
    key: Key,
    mdp: TeamMdp,
    act: Callable[[Key, TeamState, Known, M], tuple[jax.Array, M]],
    memory: M,
    start: TeamState,
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Plays one episode of a team, whose robots share one policy.

    Args:
      key: random key.
      mdp: the MDP of the team.
      act: `(key, state, known, memory) -> []` int32 choice of robot `state.agent`, and the memory
        after it. What is known holds no posterior: classes are equally likely in it.
      memory: before the first choice.
      start: from `team_mdp.reset`.

    Returns:
      `[]` rewards of all looks less the price of all robots' time, and `[]` seconds.
    """
    policy_key, looks_key = jax.random.split(key)
    num_pois = mdp.map.num_pois
    uniform = jnp.zeros((num_pois, mdp.map.num_classes)) - jnp.log(mdp.map.num_classes)

    def play(carry: _TeamCarry) -> _TeamCarry:
        state, step = carry.state, carry.state.map.steps
        times = team_mdp.travel_times(mdp.travel, state.team)
        known = Known(state.map.belief, carry.looks, uniform, state.team, times, state.agent)
        action, memory = act(jax.random.fold_in(policy_key, step), state, known, carry.memory)
        after, outcome = team_mdp.step(jax.random.fold_in(looks_key, step), mdp, state, action)
        target = state.team.target.at[state.agent].set(action)[after.agent]
        # Choices take no time, looks do; NOP, beyond the last row, is no look.
        seconds = jnp.asarray(outcome.seconds)
        own = after.team.modality[after.agent]
        reward = outcome.reward - mdp.time_price(after.team, seconds)
        return _TeamCarry(
            state=after,
            looks=carry.looks.at[target, own].add((seconds > 0).astype(jnp.int32), mode="drop"),
            memory=memory,
            done=outcome.terminated | outcome.truncated,
            total=carry.total + reward,
        )

    begin = _TeamCarry(
        state=start,
        looks=start.map.seen.astype(jnp.int32),
        memory=memory,
        done=jnp.bool_(False),
        total=jnp.float32(0.0),
    )
    end = jax.lax.while_loop(lambda carry: ~carry.done, play, begin)
    return end.total, end.state.seconds


@pytree
class _TeamCarry:
    """An episode of a team under way.

    Attributes:
      state: before a choice.
      looks: `[N, M]` int32 looks at each PoI.
      memory: of the policy.
      done: `[]` bool.
      total: `[]` return so far.
    """

    state: TeamState
    looks: jax.Array
    memory: PyTree
    done: jax.Array
    total: jax.Array


@pytree
class _Carry:
    """An episode under way.

    Attributes:
      state: of the MDP.
      looks: `[N + 1, M]` int32 looks at each PoI, and choices of NOP.
      own_looks: `[N + 1]` int32 actions in this episode.
      log_likelihood: `[N, C]` see `Start`.
      memory: of the policy.
      done: `[]` bool.
      total: `[]` reward so far.
      first: `[]` reward of the first action.
    """

    state: MapState
    looks: jax.Array
    own_looks: jax.Array
    log_likelihood: jax.Array
    memory: PyTree
    done: jax.Array
    total: jax.Array
    first: jax.Array


def every_state(
    num_pois: int, num_classes: int, num_modalities: int, limit: int = MAX_STATES
) -> tuple[Int[np.ndarray, "S N"], Bool[np.ndarray, "S N M"]]:
    """Lists the `C^N 2^(N M)` states of the map: every combination of classes, every set of looks.

    If there are more than `limit`, it takes a fixed stratified sample.

    Args:
      num_pois: N.
      num_classes: C.
      num_modalities: M.
      limit: maximum number of states.

    Returns:
      `[S, N]` int32 classes and `[S, N, M]` bool looks.
    """
    # A state is a number: a digit for the class of each PoI, then a bit for each look.
    num_bits = num_pois * num_modalities
    number = num_classes**num_pois << num_bits
    parts = min(number, limit)
    edges = [i * number // parts for i in range(parts + 1)]
    draw = random.Random(0)
    # Python's integers: the states of 25 PoIs overflow an int64.
    drawn = [draw.randrange(first, end) for first, end in itertools.pairwise(edges)]
    states = np.array(drawn, object)
    bits = states[:, None] >> np.arange(num_bits, dtype=object) & 1
    states >>= num_bits
    places = np.array([num_classes**n for n in reversed(range(num_pois))], object)
    classes = (states[:, None] // places % num_classes).astype(np.int32)
    return classes, bits.astype(bool).reshape(-1, num_pois, num_modalities)


def are_different(classes: Int[np.ndarray, "S N"]) -> Bool[np.ndarray, " S"]:
    """`[S]` bool, whether all of `[S, N]` classes differ, as in the paper's `N! 2^(N M)` states."""
    return np.all(np.diff(np.sort(classes, axis=1), axis=1) > 0, axis=1)
