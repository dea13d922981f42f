"""Runs a function only for the missions of a batch that need it."""

from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

Row = TypeVar("Row")
Result = TypeVar("Result")

_MIN_ROWS = 8  # of a group; on a CPU, fewer take as long
_NO_KIND = jnp.iinfo(jnp.int32).max


@jax.named_scope("mission.where_due")
def where_due(
    due: Bool[Array, " B"],
    function: Callable[[Row, Int[Array, ""]], Result],
    before: Result,
    inputs: Row,
    parts: int = 1,
    kinds: Int[Array, " B"] | None = None,
) -> Result:
    """Applies a function to the rows of a batch that are due, one group of rows after another.

    The rows of a group are of one kind, so that the function can branch on it: a `lax.switch`
    inside a `vmap` would take all branches. Under a `vmap`, so does this function.

    Args:
      due: `[B]` bool.
      function: takes `[S, ...]` rows of `inputs` and their `[]` kind, and returns `[S, ...]` rows.
      before: `[B, ...]` rows to keep where no work is due.
      inputs: `[B, ...]` arrays.
      parts: how many equal parts of the batch take their rows of a group from their own; with one
        part on each device, no row moves to another.
      kinds: `[B]` int32, one kind by default.

    Returns:
      `[B, ...]` rows.
    """
    kind_of_row = jnp.zeros(len(due), jnp.int32) if kinds is None else kinds
    due, kind_of_row, before, inputs = jax.tree.map(
        lambda x: x.reshape(parts, -1, *x.shape[1:]), (due, kind_of_row, before, inputs)
    )
    total, number = due.shape[1], jnp.sum(due, axis=1)
    size = min(total, max(_MIN_ROWS, total // 16))
    order = jnp.argsort(jnp.where(due, kind_of_row, _NO_KIND), axis=1)

    def rows_from(index: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Rows of each part at an index into its order, and their kinds."""
        row = jnp.take_along_axis(order, jnp.minimum(index, total - 1), axis=1)
        is_due = index < number[:, None]
        return row, jnp.where(is_due, jnp.take_along_axis(kind_of_row, row, axis=1), _NO_KIND)

    def advance(carry: tuple[jax.Array, Result]) -> tuple[jax.Array, Result]:
        first, after = carry
        row, kinds = rows_from(first[:, None] + jnp.arange(size)[None])
        kind = jnp.min(kinds[:, 0])
        taken = jax.tree.map(lambda x: jax.vmap(lambda x, row: x[row])(x, row), inputs)
        new = function(jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), taken), kind)
        is_new = kinds == kind
        kept = jnp.where(is_new, row, total)  # drops the others

        def put(rows: jax.Array, new: jax.Array) -> jax.Array:
            new = new.reshape(parts, size, *new.shape[1:])
            return jax.vmap(lambda rows, kept, new: rows.at[kept].set(new, mode="drop"))(
                rows, kept, new
            )

        return first + jnp.sum(is_new, axis=1), jax.tree.map(put, after, new)

    some_left = lambda carry: jnp.any(carry[0] < number)  # noqa: E731
    _, after = jax.lax.while_loop(some_left, advance, (jnp.zeros(parts, jnp.int32), before))
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), after)
