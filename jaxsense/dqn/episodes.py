"""Whole episodes of policies from random starts and every state of the map, and the optimum."""

import dataclasses
import itertools
import math
import random
from collections.abc import Callable
from typing import Protocol, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

from jaxsense.core.types import Fusion, Key, call, pytree
from jaxsense.dqn import mdp as mdps
from jaxsense.dqn import policies, starts
from jaxsense.dqn.mdp import Mdp, State
from jaxsense.dqn.optimum import LookValues, steps_of_lattice
from jaxsense.dqn.policies import Known, Trained

M = TypeVar("M")

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

    state: State
    log_likelihood: jax.Array


def reset(
    key: Key,
    mdp: Mdp,
    exact: LogLikelihoods,
    classes: Int[Array, " N"] | None = None,
    seen: Bool[Array, "N M"] | None = None,
) -> Start:
    """Starts an episode, see `starts.reset`."""
    state, looks = starts.reset_with_looks(key, mdp, classes, seen)
    total = jnp.zeros((mdp.num_pois, mdp.num_classes))
    for m, features in enumerate(looks):
        of_pois = jax.vmap(lambda x: exact.log_likelihoods(x, m))(features)  # noqa: B023
        total += jnp.where(state.seen[:, m : m + 1], of_pois, 0.0)
    return Start(state, total)


def run_episode(
    key: Key,
    mdp: Mdp,
    exact: LogLikelihoods,
    act: Callable[[Key, Known, M], tuple[jax.Array, M]],
    start: Start,
    memory: M = (),
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Plays one episode with a policy.

    Without travel, the k-th look at a PoI shows the same with the same key whatever came before, so
    that policies are compared on the same looks. Under `vmap` it runs until the longest episode has
    ended.

    Args:
      act: `(key, known, memory) -> []` int32 action, see `policies.best`, and the memory after it.
      memory: before the first action.

    Returns:
      Total reward, without discount, less the price of all robots' time; and that of the first
      action.
    """
    policy_key, looks_key = jax.random.split(key)
    before = start.state.seen.astype(jnp.int32)

    def play(carry: _Carry) -> _Carry:
        state, looks = carry.state, carry.looks
        posterior = jax.nn.log_softmax(carry.log_likelihood)
        team = state.team
        if mdp.is_single:  # starts may have been prepared with another sensor
            team = dataclasses.replace(team, modality=jnp.asarray(mdp.robots, jnp.int32))
        times = mdp.times(dataclasses.replace(state, team=team))
        known = Known(state.belief, looks, posterior, team, times, state.agent)
        policy = jax.random.fold_in(policy_key, state.steps)
        action, memory = act(policy, known, carry.memory)
        if mdp.teams is None:
            own = jnp.sum(looks - before, axis=1).at[action].get(mode="clip")
            look_key = jax.random.fold_in(jax.random.fold_in(looks_key, action), own)
        else:
            look_key = jax.random.fold_in(looks_key, state.steps)
        after, outcome = mdps.step(look_key, mdp, state, action)
        poi, modality = outcome.poi, mdp.sensor(after.team, after.agent)

        def of_look(m: int) -> jax.Array:
            # The same key yields the same look as in the step.
            place = jnp.minimum(poi, mdp.num_pois - 1)
            features, _ = mdp.looks.observe(look_key, state.scene, place, m, outcome.distance)
            return exact.log_likelihoods(features, m)

        found = call(of_look, modality, mdp.num_modalities)
        earned = mdp.earned(outcome, after.team)
        return _Carry(
            state=after,
            looks=looks.at[poi, modality].add(1, mode="drop"),
            log_likelihood=carry.log_likelihood.at[poi].add(found, mode="drop"),
            memory=memory,
            done=outcome.terminated | outcome.truncated,
            total=carry.total + earned,
            first=jnp.where(state.steps == start.state.steps, earned, carry.first),
        )

    carry = _Carry(
        state=start.state,
        looks=before,
        log_likelihood=start.log_likelihood,
        memory=memory,
        done=jnp.bool_(False),
        total=jnp.float32(0.0),
        first=jnp.float32(0.0),
    )
    end = jax.lax.while_loop(lambda carry: ~carry.done, play, carry)
    return end.total, end.first


@pytree
class _Carry:
    """An episode under way."""

    state: State
    looks: jax.Array
    log_likelihood: jax.Array
    memory: PyTree
    done: jax.Array
    total: jax.Array
    first: jax.Array


def every_state(
    num_pois: int, num_classes: int, num_modalities: int, limit: int = 4096
) -> tuple[Int[np.ndarray, "S N"], Bool[np.ndarray, "S N M"]]:
    """Lists the `C^N 2^(N M)` states of the map: every combination of classes, every set of looks.

    If there are more than `limit`, it takes a fixed stratified sample.

    Returns:
      Classes of the PoIs, and which modality has looked at which PoI.
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


Reference = Callable[[Known, jax.Array], jax.Array]
"""`(known, classes [N]) -> [N + 1]` values; the true classes are hidden from all other policies."""


def reference(key: Key, mdp: Mdp, models: Trained, labels: Int[Array, "M C"]) -> Reference:
    """The optimal policy of one robot without travel, which learned policies are measured against.

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
        return lambda known, classes: policies.UNORDERED["optimal"](key, models, known)
    rewards = expected_rewards(key, mdp)
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


def expected_rewards(key: Key, mdp: Mdp, num_draws: int = _NUM_DRAWS) -> Float[Array, "codes C"]:
    """Expected reward of one robot's look, by class and earlier looks.

    Returns:
      Mean reward of looking at a PoI of class c after looks by the modalities m whose bits m are
      set in the first index.
    """

    def reward(given: tuple[Key, jax.Array, jax.Array]) -> jax.Array:
        key, code, poi_class = given
        reset_key, look_key = jax.random.split(key)
        bits = (code >> jnp.arange(mdp.num_modalities) & 1).astype(bool)
        seen = jnp.broadcast_to(bits, (mdp.num_pois, mdp.num_modalities))
        classes = jnp.full(mdp.num_pois, poi_class)
        state = starts.reset(reset_key, mdp, classes, seen)
        return mdps.step(look_key, mdp, state, jnp.int32(0))[1].reward

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
