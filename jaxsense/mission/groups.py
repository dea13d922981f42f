"""Runs a function only for the missions of a batch that need it."""

from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int, Shaped

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
    of_row = jnp.zeros(len(due), jnp.int32) if kinds is None else kinds
    due, of_row = due.reshape(parts, -1), of_row.reshape(parts, -1)
    total, number = due.shape[1], jnp.sum(due, axis=1)
    size = min(total, max(_MIN_ROWS, total // 16))
    order = jnp.argsort(jnp.where(due, of_row, _NO_KIND), axis=1)

    def advance(carry: tuple[jax.Array, Result]) -> tuple[jax.Array, Result]:
        first, after = carry
        index = first[:, None] + jnp.arange(size)[None]
        row = jnp.take_along_axis(order, jnp.minimum(index, total - 1), axis=1)
        kind_of = jnp.take_along_axis(of_row, row, axis=1)
        kind_of = jnp.where(index < number[:, None], kind_of, _NO_KIND)
        kind = jnp.min(kind_of[:, 0])
        is_new = kind_of == kind
        new = function(jax.tree.map(lambda x: _rows_of(x, row), inputs), kind)
        kept = jnp.where(is_new, row, total)  # drops the others
        after = jax.tree.map(lambda x, new: _with_rows(x, kept, new), after, new)
        return first + jnp.sum(is_new, axis=1), after

    some_left = lambda carry: jnp.any(carry[0] < number)  # noqa: E731
    return jax.lax.while_loop(some_left, advance, (jnp.zeros(parts, jnp.int32), before))[1]


def _rows_of(x: Shaped[Array, "B ..."], row: Int[Array, "P S"]) -> Shaped[Array, "PS ..."]:
    """Rows of each of P parts of an array."""
    get = lambda x, row: x.at[row].get(mode="promise_in_bounds", wrap_negative_indices=False)  # noqa: E731
    if len(row) == 1:
        return get(x, row[0])
    of_parts = jax.vmap(get)(x.reshape(len(row), -1, *x.shape[1:]), row)
    return of_parts.reshape(-1, *x.shape[1:])


def _with_rows(
    x: Shaped[Array, "B ..."], row: Int[Array, "P S"], new: Shaped[Array, "PS ..."]
) -> Shaped[Array, "B ..."]:
    """An array with new rows in each of P parts, except for those beyond the part's end."""
    put = lambda x, row, new: x.at[row].set(new, mode="drop", wrap_negative_indices=False)  # noqa: E731
    if len(row) == 1:
        return put(x, row[0], new)
    x_of, new_of = (each.reshape(len(row), -1, *each.shape[1:]) for each in (x, new))
    return jax.vmap(put)(x_of, row, new_of).reshape(x.shape)
