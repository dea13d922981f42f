"""Whole episodes of policies from random starts and every state of the map, and the optimum."""

import itertools
import math
import random
from collections.abc import Callable
from typing import Protocol, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

from jaxsense.core.types import Fusion, Index, Key, call, pytree
from jaxsense.dqn import map_mdp, policies, team_mdp
from jaxsense.dqn.map_mdp import MapMdp, MapState
from jaxsense.dqn.optimum import LookValues, steps_of_lattice
from jaxsense.dqn.policies import Known, Trained
from jaxsense.dqn.team_mdp import TeamMdp, TeamState, alone

M = TypeVar("M")

MAX_STATES = 4096
_NUM_DRAWS = 1024
_AT_ONCE = 1024  # simulated looks, to save memory
_FINE = 16  # steps of a lattice between whose points values are right to a hundredth


class LogLikelihoods(Protocol):
    """How the exact Bayes filter reads a look; see `vae.readout.Bayes`."""

    def log_likelihoods(self, features: Float[Array, " L"], modality: int) -> Float[Array, " C"]:
        """Log-likelihood of each class given one look."""
        ...


@pytree
class Start:
    """The first state of an episode, and what policies know besides.

    Attributes:
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
    """Starts an episode, see `map_mdp.reset`."""
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
      act: `(key, known) -> []` int32 action, see `policies.best`.

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
      act: `(key, known, memory) -> []` int32 action, and the memory after it.
    """
    num_pois, team = mdp.num_pois, alone(mdp.num_pois, modality)
    times = jnp.ones((1, num_pois))
    policy_key, looks_key = jax.random.split(key)

    def play(carry: _Carry) -> _Carry:
        state, looks = carry.state, carry.looks
        posterior = jax.nn.log_softmax(carry.log_likelihood)
        known = Known(state.belief, looks[:num_pois], posterior, team, times, jnp.int32(0))
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
) -> Float[Array, ""]:
    """Rewards of all looks less the price of all robots' time, in one episode of a team.

    Args:
      act: `(key, state, known, memory) -> []` int32 choice of robot `state.agent`, and the memory
        after it. What is known holds no posterior: classes are equally likely in it.
    """
    policy_key, looks_key = jax.random.split(key)
    num_pois = mdp.map.num_pois
    uniform = jnp.zeros((num_pois, mdp.map.num_classes)) - jnp.log(mdp.map.num_classes)

    def play(carry: tuple[TeamState, jax.Array, M, jax.Array, jax.Array]):
        state, looks, memory, _, total = carry
        step = state.map.steps
        times = team_mdp.travel_times(mdp.travel, state.team)
        known = Known(state.map.belief, looks, uniform, state.team, times, state.agent)
        action, memory = act(jax.random.fold_in(policy_key, step), state, known, memory)
        after, outcome = team_mdp.step(jax.random.fold_in(looks_key, step), mdp, state, action)
        target = state.team.target.at[state.agent].set(action)[after.agent]
        # Choices take no time, looks do; NOP, beyond the last row, is no look.
        seconds = jnp.asarray(outcome.seconds)
        own = after.team.modality[after.agent]
        looks = looks.at[target, own].add((seconds > 0).astype(jnp.int32), mode="drop")
        total += outcome.reward - mdp.time_price(after.team, seconds)
        return after, looks, memory, outcome.terminated | outcome.truncated, total

    seen = start.map.seen.astype(jnp.int32)
    begin = start, seen, memory, jnp.bool_(False), jnp.float32(0.0)
    return jax.lax.while_loop(lambda carry: ~carry[3], play, begin)[4]


@pytree
class _Carry:
    """An episode under way; `[N + 1]` looks and choices of NOP."""

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


Reference = Callable[[Known, jax.Array], jax.Array]
"""`(known, classes [N]) -> [N + 1]` values; the true classes are hidden from all other policies."""


def reference(
    key: Key, mdp: MapMdp, modality: Index, models: Trained, labels: Int[Array, "M C"]
) -> Reference:
    """The optimal policy of an MDP, which learned policies are measured against.

    Where beliefs accumulate looks, it is the policy `optimal` of missions, by dynamic programming
    on the exact posterior. Where a look replaces the one before, a second look by the same sensor
    never pays; then it takes every look whose simulated reward pays on average, given what the
    earlier looks can reveal.

    Args:
      key: of the simulated rewards.
      models: whose fusion is the MDP's.
      labels: the label of each class in each modality.
    """
    if mdp.fusion.accumulates:
        return lambda known, classes: policies.optimal(key, models, known)
    rewards = expected_rewards(key, mdp, modality)
    return lambda known, classes: _informed(rewards, labels, known.looks > 0, classes)


def has_optimum(fusion: Fusion, values: LookValues, is_sound: bool) -> bool:
    """Whether `reference` is the optimum, up to the error of a fine lattice.

    Args:
      is_sound: whether the map's class probabilities roughly match exact Bayes; if not, only
        rewards that do not read them, on a map that does not accumulate, have an optimum.
    """
    if not is_sound and (fusion.accumulates or values.labels is not None):
        return False
    number = len(fusion.classes.mean) if values.labels is None else values.labels.shape[1]
    return not fusion.accumulates or steps_of_lattice(number, len(values.q)) >= _FINE


def expected_rewards(
    key: Key, mdp: MapMdp, modality: Index, num_draws: int = _NUM_DRAWS
) -> Float[Array, "codes C"]:
    """Expected reward of a look, by class and earlier looks.

    Returns:
      `[2^M, C]` mean reward of looking at a PoI of class c after looks by the modalities m whose
      bits m are set in the first index.
    """

    def reward(given: tuple[Key, jax.Array, jax.Array]) -> jax.Array:
        key, code, poi_class = given
        reset_key, look_key = jax.random.split(key)
        bits = (code >> jnp.arange(mdp.num_modalities) & 1).astype(bool)
        seen = jnp.broadcast_to(bits, (mdp.num_pois, mdp.num_modalities))
        classes = jnp.full(mdp.num_pois, poi_class)
        state = map_mdp.reset(reset_key, mdp, classes, seen)
        return map_mdp.step(look_key, mdp, state, jnp.int32(0), modality)[1].reward

    # Along one axis: one `vmap` in another takes three times as long to compile.
    shape = (2**mdp.num_modalities, mdp.num_classes, num_draws)
    codes, classes, _ = jnp.unravel_index(jnp.arange(math.prod(shape)), shape)
    looks = (jax.random.split(key, math.prod(shape)), codes, classes)
    rewards = jax.lax.map(reward, looks, batch_size=_AT_ONCE)  # networks read all N PoIs
    return rewards.reshape(shape).mean(axis=-1)


def _informed(
    rewards: jax.Array, labels: jax.Array, seen: jax.Array, classes: jax.Array
) -> jax.Array:
    """`[N + 1]` mean rewards of looks over the classes that the labels seen so far leave open.

    It knows the true labels of earlier looks, not their noise. Taking every look that pays is
    optimal, because PoIs are independent and the order is free.
    """

    def of_poi(seen: jax.Array, poi_class: jax.Array) -> jax.Array:
        is_same = labels == labels[:, poi_class][:, None]
        is_open = jnp.all(is_same | ~seen[:, None], axis=0)
        code = jnp.sum(seen << jnp.arange(len(labels)))
        return jnp.sum(rewards[code] * is_open) / jnp.sum(is_open)

    return jnp.append(jax.vmap(of_poi)(seen, classes), 0.0)
