"""Checks of functions' arguments, in the form of `ConfigError`: `name = value: what is right`.

Traced values are unknown: their checks pass and cost nothing.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer


def require(
    name: str, value: Any, is_right: Callable[[np.ndarray], np.ndarray], expected: str
) -> None:
    """Raises a `ValueError` that names the first wrong number of an array.

    Args:
      name: of the argument.
      value: the array.
      is_right: `array -> bool array`, which of its numbers are right.
      expected: what would be right.
    """
    if isinstance(value, Tracer):
        return
    values = np.asarray(value)
    if values.dtype.kind in "OSU":
        raise ValueError(f"{name} = {value!r}: {expected}")
    wrong = values[~np.asarray(is_right(values))]
    if wrong.size:
        raise ValueError(f"{name} = {wrong.flat[0]}: {expected}")


def require_positive(name: str, value: Any) -> None:
    """Raises a `ValueError` unless all numbers are finite and greater than 0."""
    require(name, value, lambda x: np.isfinite(x) & (x > 0), "must be greater than 0")


def require_finite(name: str, value: Any) -> None:
    """Raises a `ValueError` unless all numbers are finite."""
    require(name, value, np.isfinite, "must be finite")


def require_probabilities(name: str, value: Any) -> None:
    """Raises a `ValueError` unless all numbers are within 0 and 1, and their sum is 1."""
    require(name, value, lambda x: (x >= 0) & (x <= 1), "must be probabilities, within 0 and 1")
    if not isinstance(value, Tracer):
        total = np.sum(np.asarray(value), axis=-1)
        require(f"sum of {name}", total, lambda x: np.abs(x - 1) < 1e-3, "must be 1")


def require_index(name: str, value: Any, number: int) -> None:
    """Raises a `ValueError` unless all numbers are whole and within 0 and `number - 1`."""
    expected = f"must be a whole number from 0 to {number - 1}"
    dtype = jnp.result_type(value)
    if not jnp.issubdtype(dtype, jnp.integer):
        raise ValueError(f"{name} of dtype {dtype}: {expected}")
    require(name, value, lambda x: (x >= 0) & (x < number), expected)


def require_number(name: str, value: Any) -> None:
    """Raises a `ValueError` unless the value is one whole number greater than 0."""
    is_whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
    if not is_whole or value < 1:
        raise ValueError(f"{name} = {value!r}: must be a whole number greater than 0")


def require_one_each(name: str, values: Sequence[Any], modalities: Sequence[str]) -> None:
    """Raises a `ValueError` unless each modality has one value."""
    if len(values) != len(modalities):
        raise ValueError(
            f"{name} has {len(values)} entries: must be {len(modalities)}, one for each of "
            f"{tuple(modalities)}"
        )
