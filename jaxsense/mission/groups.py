"""Work that is due in a few of the missions side by side, at its cost alone."""

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp

T = TypeVar("T")

_FEWEST = 8  # rows of a group; fewer take as long


def where_due(due: jax.Array, function: Callable[..., T], before: T, *inputs: Any) -> T:
    """Applies a function to the rows of a batch that are due, in groups.

    Args:
      due: `[B]` bool.
      function: of a single row of each input; returns a single row.
      before: `[B, ...]` rows, which the others keep.
      *inputs: `[B, ...]` each.

    Returns:
      `[B, ...]` rows.
    """
    total, number = len(due), jnp.sum(due)
    size = min(total, max(_FEWEST, total // 16))
    order = jnp.argsort(~due)

    def advance(carry: tuple[jax.Array, T]) -> tuple[jax.Array, T]:
        first, after = carry
        place = first + jnp.arange(size)
        row = order[jnp.minimum(place, total - 1)]
        new = jax.vmap(function)(*jax.tree.map(lambda x: x[row], inputs))
        kept = jnp.where(place < number, row, total)  # beyond the last row, nothing is written
        put = lambda rows, new: rows.at[kept].set(new, mode="drop")  # noqa: E731
        return first + size, jax.tree.map(put, after, new)

    return jax.lax.while_loop(lambda carry: carry[0] < number, advance, (jnp.int32(0), before))[1]
