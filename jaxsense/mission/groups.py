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
      kinds: `[B]` int32, one kind by default.

    Returns:
      `[B, ...]` rows.
    """
    of_row = jnp.zeros(len(due), jnp.int32) if kinds is None else kinds
    total, number = len(due), jnp.sum(due)
    size = min(total, max(_MIN_ROWS, total // 16))
    order = jnp.argsort(jnp.where(due, of_row, _NO_KIND))

    def rows_of(x: Shaped[Array, "B ..."], row: Int[Array, " S"]) -> Shaped[Array, "S ..."]:
        return x.at[row].get(mode="promise_in_bounds", wrap_negative_indices=False)

    def advance(carry: tuple[jax.Array, Result]) -> tuple[jax.Array, Result]:
        first, after = carry
        index = first + jnp.arange(size)
        row = rows_of(order, jnp.minimum(index, total - 1))
        kind_of = jnp.where(index < number, rows_of(of_row, row), _NO_KIND)
        kind = kind_of[0]
        is_new = kind_of == kind
        new = function(jax.tree.map(lambda x: rows_of(x, row), inputs), kind)
        kept = jnp.where(is_new, row, total)  # drops the others

        def put(x: Shaped[Array, "B ..."], new: Shaped[Array, "S ..."]) -> Shaped[Array, "B ..."]:
            return x.at[kept].set(new, mode="drop", wrap_negative_indices=False)

        return first + jnp.sum(is_new), jax.tree.map(put, after, new)

    some_left = lambda carry: carry[0] < number  # noqa: E731
    return jax.lax.while_loop(some_left, advance, (jnp.int32(0), before))[1]
