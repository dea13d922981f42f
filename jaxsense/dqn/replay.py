"""A replay memory as pure functions: a ring of rounds, with one item of each environment in each.

Environments have an axis of their own, and every draw is tied to a few of them, so that a memory
can be split over devices: what a device draws lies on that device.
"""

from typing import Any

import chex
import jax
import jax.numpy as jnp
from flax import struct


@struct.dataclass
class Replay:
    """The memory.

    Attributes:
      items: pytree of `[T, E, ...]` arrays, T rounds of E environments.
      count: `[]` int32, rounds ever added.
    """

    items: Any
    count: jax.Array


def init(example: Any, rounds: int, num_envs: int) -> Replay:
    """An empty memory for rounds of items like `example`, one of each environment."""
    items = jax.tree.map(
        lambda x: jnp.zeros((rounds, num_envs, *jnp.shape(x)), jnp.asarray(x).dtype), example
    )
    return Replay(items, jnp.int32(0))


def add(replay: Replay, items: Any) -> Replay:
    """Adds a round, `[E, ...]` of items, over the oldest one."""
    shape = jax.tree.map(lambda ring: ring[0], replay.items)
    chex.assert_trees_all_equal_shapes_and_dtypes(shape, items)
    rounds = jax.tree.leaves(replay.items)[0].shape[0]
    place = replay.count % rounds
    ring = jax.tree.map(
        lambda ring, new: jax.lax.dynamic_update_index_in_dim(ring, new, place, 0),
        replay.items,
        items,
    )
    return Replay(ring, replay.count + 1)


def sample(draws: jax.Array, replay: Replay) -> Any:
    """Draws items from a memory that is not empty.

    All items are drawn with the same chance: the round is uniform and with replacement; of the
    environments, in order, each draw gets an equal share and takes one of it.

    Args:
      draws: `[B, 2]` uniform numbers in [0, 1), for the round and for the environment.
      replay: the memory.

    Returns:
      `[B, ...]` items.
    """
    chex.assert_shape(draws, (None, 2), custom_message="draws")
    rounds, num_envs = jax.tree.leaves(replay.items)[0].shape[:2]
    filled = jnp.minimum(replay.count, rounds)
    size = draws.shape[0]
    # Rounding may lift a product to the end of its range.
    row = jnp.minimum((draws[:, 0] * filled).astype(jnp.int32), filled - 1)
    share = (jnp.arange(size) + draws[:, 1]) * (num_envs / size)
    env = jnp.minimum(share.astype(jnp.int32), num_envs - 1)
    return jax.tree.map(lambda ring: ring[row, env], replay.items)
