"""Replay memory as pure functions: a ring buffer of rounds, with a transition per environment.

Transitions are columns, drawn in blocks of neighbouring environments: copying a few pieces of
memory is many times faster than picking single numbers.
"""

import chex
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsense.core import checks
from jaxsense.core.types import Transition, pytree


@pytree
class Replay:
    """The replay memory.

    Attributes:
      columns: `[T, G, K, W]` float32, T rounds of G blocks of W environments.
      count: `[]` int32, rounds ever added.
    """

    columns: jax.Array
    count: jax.Array


def init(state_size: int, rounds: int, blocks: int, width: int) -> Replay:
    """Creates an empty memory.

    Args:
      state_size: numbers in a state.
      rounds: capacity, T.
    """
    sizes = {"state_size": state_size, "rounds": rounds, "blocks": blocks, "width": width}
    for name, size in sizes.items():
        checks.require_number(name, size)
    return Replay(jnp.zeros((rounds, blocks, 2 * state_size + 3, width)), jnp.int32(0))


def add(replay: Replay, transitions: Transition) -> Replay:
    """Adds a round, which replaces the oldest once the memory is full.

    Args:
      transitions: `[S, E]` states, `[E]` other fields; stored as float32.
    """
    rounds, blocks, rows, width = replay.columns.shape
    state, number = ((rows - 3) // 2, blocks * width), (blocks * width,)
    shapes = {"s_tm1": state, "a_tm1": number, "r_t": number, "discount_t": number, "s_t": state}
    for name, shape in shapes.items():
        checks.require_shape(f"transitions.{name}", getattr(transitions, name), shape)
    # Actions beyond 256 have no name in 16 bits.
    given = jax.tree.map(lambda x: x.astype(replay.columns.dtype), transitions)
    scalars = jnp.stack([given.a_tm1, given.r_t, given.discount_t])
    columns = jnp.concatenate([given.s_tm1, given.s_t, scalars])
    in_blocks = jnp.moveaxis(columns.reshape(rows, blocks, width), 1, 0)
    place = replay.count % rounds
    ring = jax.lax.dynamic_update_index_in_dim(replay.columns, in_blocks, place, 0)
    return Replay(ring, replay.count + 1)


def sample(draws: Float[Array, "B 2"], replay: Replay) -> Transition:
    """Draws blocks of transitions from a memory that is not empty.

    All transitions are equally likely: rounds are uniform, with replacement; each draw takes one of
    its equal share of the blocks of environments, in order.

    Args:
      draws: uniform numbers in [0, 1), for the round and for the block.

    Returns:
      `[S, B * W]` states, and `[B * W]` other fields.
    """
    chex.assert_shape(draws, (None, 2))
    if draws.dtype.itemsize < 4:
        raise ValueError(f"draws of dtype {draws.dtype}: must be float32, to reach every round")
    checks.require("rounds in replay", replay.count, lambda x: x > 0, "must be 1 or more; add some")
    rounds, blocks, rows, width = replay.columns.shape
    filled = jnp.minimum(replay.count, rounds)
    size = draws.shape[0]
    row = (draws[:, 0] * filled.astype(draws.dtype)).astype(jnp.int32)
    # Rounding may lift a sum, though not a product, to the end of its range.
    share = (jnp.arange(size, dtype=draws.dtype) + draws[:, 1]) * (blocks / size)
    block = jnp.minimum(share.astype(jnp.int32), blocks - 1)
    drawn = replay.columns[row, block]
    columns = jnp.moveaxis(drawn, 0, 1).reshape(rows, size * width)
    s_tm1, s_t, (action, reward, discount) = jnp.split(columns, [rows // 2 - 1, rows - 3])
    return Transition(s_tm1, action.astype(jnp.int32), reward, discount, s_t)
