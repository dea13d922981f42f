"""Whole episodes of policies, from random starts and from every state of the map."""

import itertools
import random
from collections.abc import Callable
from typing import Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxsense.core.types import Index, Key, call, pytree
from jaxsense.dqn import map_mdp
from jaxsense.dqn.map_mdp import MapMdp, MapState
from jaxsense.dqn.policies import Known
from jaxsense.dqn.team_mdp import alone

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
        action = act(jax.random.fold_in(policy_key, state.steps), known)
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
        done=jnp.bool_(False),
        total=jnp.float32(0.0),
        first=jnp.float32(0.0),
    )
    end = jax.lax.while_loop(lambda carry: ~carry.done, play, carry)
    return end.total, end.first


@pytree
class _Carry:
    """An episode under way.

    Attributes:
      state: of the MDP.
      looks: `[N + 1, M]` int32 looks at each PoI, and choices of NOP.
      own_looks: `[N + 1]` int32 actions in this episode.
      log_likelihood: `[N, C]` see `Start`.
      done: `[]` bool.
      total: `[]` reward so far.
      first: `[]` reward of the first action.
    """

    state: MapState
    looks: jax.Array
    own_looks: jax.Array
    log_likelihood: jax.Array
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
