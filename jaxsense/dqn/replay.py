"""A replay memory: a ring of transitions, uniform draws, pure functions."""

from typing import Any

import chex
import jax
import jax.numpy as jnp
from flax import struct

from jaxsense.types import Key


@struct.dataclass
class Replay:
    """The memory.

    Attributes:
      items: pytree of `[capacity, ...]` arrays.
      count: `[]` int32, items ever added.
    """

    items: Any
    count: jax.Array


def init(example: Any, capacity: int) -> Replay:
    """An empty memory for `capacity` items like `example`."""
    items = jax.tree.map(
        lambda x: jnp.zeros((capacity, *jnp.shape(x)), jnp.asarray(x).dtype), example
    )
    return Replay(items, jnp.int32(0))


def add(replay: Replay, batch: Any) -> Replay:
    """Adds a batch of B items over the oldest ones.

    Raises:
      ValueError: if B does not divide the capacity. That B is the same every time is not checked.
    """
    size = jax.tree.leaves(batch)[0].shape[0]
    capacity = jax.tree.leaves(replay.items)[0].shape[0]
    if capacity % size:
        raise ValueError(f"batch of {size} items: must divide the replay's capacity of {capacity}")
    chex.assert_trees_all_equal_dtypes(replay.items, batch)
    start = replay.count % capacity
    items = jax.tree.map(
        lambda ring, new: jax.lax.dynamic_update_slice_in_dim(ring, new, start, 0),
        replay.items,
        batch,
    )
    return Replay(items, replay.count + size)


def sample(key: Key, replay: Replay, size: int) -> Any:
    """Draws `size` items, uniformly and with replacement, of a memory that is not empty."""
    capacity = jax.tree.leaves(replay.items)[0].shape[0]
    filled = jnp.minimum(replay.count, capacity)
    rows = jax.random.randint(key, (size,), 0, filled)
    return jax.tree.map(lambda ring: ring[rows], replay.items)
