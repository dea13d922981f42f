"""The optimal policy of the map MDP, which learned policies are measured against.

Where beliefs accumulate looks, it is the policy `optimal` of missions, by dynamic programming on
the exact posterior. Where a look replaces the one before, a second look by the same sensor never
pays; then it takes every look whose simulated reward pays on average, given what the earlier looks
can reveal.
"""

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxsense.core.types import Fusion, Index, Key
from jaxsense.dqn import map_mdp, policies
from jaxsense.dqn.map_mdp import MapMdp
from jaxsense.dqn.optimum import LookValues, steps_of_lattice
from jaxsense.dqn.policies import Known, Trained

_NUM_DRAWS = 1024
_AT_ONCE = 1024  # simulated looks, to save memory
_FINE = 16  # steps of a lattice between whose points values are right to a hundredth

Reference = Callable[[Known, jax.Array], jax.Array]
"""`(known, classes [N]) -> [N + 1]` values; the true classes are hidden from all other policies."""


def reference(
    key: Key, mdp: MapMdp, modality: Index, models: Trained, labels: Int[Array, "M C"]
) -> Reference:
    """The optimal policy of an MDP.

    Args:
      key: random key of the simulated rewards.
      mdp: the MDP.
      modality: index of the agent's own sensor, see `map_mdp.step`.
      models: trained models, whose fusion is the MDP's.
      labels: the label of each class in each modality.
    """
    if mdp.fusion.accumulates:
        return lambda known, classes: policies.optimal(key, models, known)
    rewards = expected_rewards(key, mdp, modality)
    return lambda known, classes: _informed(rewards, labels, known.looks > 0, classes)


def has_optimum(fusion: Fusion, values: LookValues, is_sound: bool) -> bool:
    """Whether `reference` is the optimum, up to the error of a fine lattice.

    Args:
      fusion: of the MDP.
      values: of the agent's own sensor.
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

    Args:
      key: random key.
      mdp: the MDP.
      modality: index of the agent's own sensor, see `map_mdp.step`.
      num_draws: simulated looks for each number in the table; static.

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
