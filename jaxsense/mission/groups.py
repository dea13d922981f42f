"""Runs a function only for the missions of a batch that need it."""

from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

Row = TypeVar("Row")
Result = TypeVar("Result")

_MIN_ROWS = 8  # of a group; on a CPU, fewer take as long


@jax.named_scope("mission.where_due")
def where_due(
    due: Bool[Array, " B"],
    function: Callable[[Row], Result],
    before: Result,
    inputs: Row,
    parts: int = 1,
) -> Result:
    """Applies a function to the rows of a batch that are due, one group of rows after another.

    Under a `vmap`, all batches take as many groups as the one with the most rows.

    Args:
      due: `[B]` bool.
      function: takes one row of `inputs`, and returns one row.
      before: `[B, ...]` rows to keep where no work is due.
      inputs: `[B, ...]` arrays.
      parts: how many equal parts of the batch form groups of their own; with one part on each
        device, no row moves to another.

    Returns:
      `[B, ...]` rows.
    """
    if parts == 1:
        return _where_due(due, function, before, inputs)
    due, before, inputs = jax.tree.map(
        lambda x: x.reshape(parts, -1, *x.shape[1:]), (due, before, inputs)
    )
    of_part = jax.vmap(lambda due, before, inputs: _where_due(due, function, before, inputs))
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), of_part(due, before, inputs))


def _where_due(
    due: Bool[Array, " B"], function: Callable[[Row], Result], before: Result, inputs: Row
) -> Result:
    """See `where_due`, for a batch of one part."""
    total, number = len(due), jnp.sum(due)
    size = min(total, max(_MIN_ROWS, total // 16))
    order = jnp.argsort(~due)

    def advance(carry: tuple[jax.Array, Result]) -> tuple[jax.Array, Result]:
        first, after = carry
        index = first + jnp.arange(size)
        row = order[jnp.minimum(index, total - 1)]
        new = jax.vmap(function)(jax.tree.map(lambda x: x[row], inputs))
        kept = jnp.where(index < number, row, total)  # drops rows beyond the last that is due
        put = lambda rows, new: rows.at[kept].set(new, mode="drop")  # noqa: E731
        return first + size, jax.tree.map(put, after, new)

    return jax.lax.while_loop(lambda carry: carry[0] < number, advance, (jnp.int32(0), before))[1]
