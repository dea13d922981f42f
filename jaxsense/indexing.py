"""Indices that may be Python's, fixed while tracing, or JAX's, so that one program serves all."""

import functools
from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np

T = TypeVar("T")

Index = int | jax.Array
"""A Python integer, or a `[]` int32 array."""


def is_static(index: Index) -> bool:
    """Whether an index is fixed while tracing."""
    return isinstance(index, int | np.integer)


def call(function: Callable[[int], T], index: Index, number: int) -> T:
    """`function(index)` of a function that can take a static index only.

    Args:
      function: gives results of the same shapes for every index.
      index: which; if it is an array, the program switches between all that there are.
      number: how many there are.
    """
    if is_static(index):
        return function(int(index))
    return jax.lax.switch(index, [functools.partial(function, i) for i in range(number)])


def others(rows: jax.Array, index: Index) -> jax.Array:
    """`[R - 1, ...]` all of `[R, ...]` rows but one, beginning with the one after it."""
    number = len(rows)
    return rows[(index + 1 + jnp.arange(number - 1)) % number]
