"""Whole episodes of policies, from random starts and from every state of the map."""

import itertools
import random

import jax
import jax.numpy as jnp
import numpy as np

from jaxsense.core.types import Index, Key
from jaxsense.dqn import belief_mdp
from jaxsense.dqn.belief_mdp import MapMdp, MapState
from jaxsense.dqn.policies import Policy

MOST_STATES = 4096


def run_episode(
    key: Key, mdp: MapMdp, policy: Policy, start: MapState, modality: Index
) -> tuple[jax.Array, jax.Array]:
    """Plays one episode with a policy.

    With the same key, the k-th look at a PoI sees the same whatever came before, so that policies
    are compared on the same detections. Under `vmap` it runs until the longest episode has ended.

    Args:
      key: random key.
      mdp: the MDP.
      policy: chooses the actions.
      start: from `belief_mdp.reset`.
      modality: index of the agent's own sensor, see `belief_mdp.step`.

    Returns:
      `[]` total reward, without discount, and `[]` reward of the first action.
    """

    def goes_on(carry) -> jax.Array:
        return ~carry[1]

    def act(carry):
        state, _, total, first, times = carry
        action = policy(jax.random.fold_in(policy_key, state.steps), state)
        look_key = jax.random.fold_in(jax.random.fold_in(looks_key, action), times[action])
        is_first = state.steps == start.steps
        state, outcome = belief_mdp.step(look_key, mdp, state, action, modality)
        first = jnp.where(is_first, outcome.reward, first)
        terminated = outcome.terminated | outcome.truncated
        return state, terminated, total + outcome.reward, first, times.at[action].add(1)

    policy_key, looks_key = jax.random.split(key)
    times = jnp.zeros(mdp.num_pois + 1, jnp.int32)
    carry = (start, jnp.bool_(False), jnp.float32(0.0), jnp.float32(0.0), times)
    _, _, total, first, _ = jax.lax.while_loop(goes_on, act, carry)
    return total, first


def every_state(
    num_pois: int, num_classes: int, num_modalities: int, most: int = MOST_STATES
) -> tuple[np.ndarray, np.ndarray]:
    """Lists the `C^N 2^(N M)` states of the map: every combination of classes, every set of looks.

    Of more than `most` states, one random state, always the same, of each of that many equal parts.

    Returns:
      `[S, N]` int32 classes and `[S, N, M]` bool looks.
    """
    # A state is a number: a digit for the class of each PoI, then a bit for each look.
    num_bits = num_pois * num_modalities
    number = num_classes**num_pois << num_bits
    parts = min(number, most)
    edges = [i * number // parts for i in range(parts + 1)]
    draw = random.Random(0)
    # Python's integers: the states of 25 PoIs overflow an int64.
    states = np.array([draw.randrange(*part) for part in itertools.pairwise(edges)], object)
    bits = states[:, None] >> np.arange(num_bits, dtype=object) & 1
    states >>= num_bits
    places = np.array([num_classes**n for n in reversed(range(num_pois))], object)
    classes = (states[:, None] // places % num_classes).astype(np.int32)
    return classes, bits.astype(bool).reshape(-1, num_pois, num_modalities)


def are_different(classes: np.ndarray) -> np.ndarray:
    """`[S]` bool, whether all of `[S, N]` classes differ, as in the paper's `N! 2^(N M)` states."""
    return np.all(np.diff(np.sort(classes, axis=1), axis=1) > 0, axis=1)
