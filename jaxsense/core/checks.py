"""Checks at public doors, in the form of `ConfigError`: `name = value: what is right`.

All raise `ValueError`, which names the argument. Traced values are unknown: only their shapes and
types are checked.
"""

import dataclasses
import functools
import inspect
from collections.abc import Callable, Sequence
from types import EllipsisType
from typing import ParamSpec, Protocol, TypeVar, get_type_hints

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from jaxsense.core.types import Belief

P = ParamSpec("P")
T = TypeVar("T")

_MOST_SHOWN = 200  # characters of a value
NUMBERS = jax.Array | np.ndarray | np.generic | float | int
"""What holds one number or several."""
_Shape = Sequence[int | EllipsisType | None]


def require(
    name: str, value: object, is_right: Callable[[np.ndarray], np.ndarray], expected: str
) -> None:
    """All numbers of an array are right, by a function from arrays to bools."""
    if isinstance(value, Tracer):
        return
    values = np.asarray(value)
    if values.dtype.kind in "OSUc":
        raise ValueError(f"{name} = {shown(value)}: {expected}")
    wrong = values[~np.asarray(is_right(values))]
    if wrong.size:
        raise ValueError(f"{name} = {wrong.flat[0]}: {expected}")


def shown(value: object) -> str:
    """A value in one short line; a function by its name, a dataclass by that of its class."""
    while isinstance(value, functools.partial):
        value = value.func
    if not isinstance(value, type) and (callable(value) or dataclasses.is_dataclass(value)):
        return getattr(value, "__name__", type(value).__name__)
    try:
        text = " ".join(repr(value).split())
    except (RecursionError, ValueError):  # a thousand levels, or more than 4300 digits
        return f"a huge {type(value).__name__}"
    return text if len(text) <= _MOST_SHOWN else f"{text[:_MOST_SHOWN]}..."


def require_positive(name: str, value: object) -> None:
    """All numbers are finite and greater than 0."""
    require(name, value, lambda x: np.isfinite(x) & (x > 0), "must be greater than 0")


def require_finite(name: str, value: object, expected: str = "must be finite") -> None:
    """All numbers are finite."""
    require(name, value, np.isfinite, expected)


def require_probabilities(name: str, value: object) -> None:
    """All numbers of `[..., C]` are within 0 and 1, and sum to 1 over C."""
    require(name, value, lambda x: (x >= 0) & (x <= 1), "must be probabilities, within 0 and 1")
    if not isinstance(value, Tracer):
        total = np.sum(np.asarray(value), axis=-1)
        require(f"sum of {name}", total, lambda x: np.abs(x - 1) < 1e-3, "must be 1")


def require_shape(name: str, value: object, shape: _Shape) -> None:
    """An array has a shape: None for an axis of any size, `...` at either end for any axes."""
    expected = str(tuple(shape)).replace("None", "any").replace("Ellipsis", "...")
    if not isinstance(value, NUMBERS):
        raise ValueError(f"{name} = {shown(value)}: must be an array of shape {expected}")
    try:
        chex.assert_shape(value, tuple(shape))
    except AssertionError:
        found = f"{name} has the shape {np.shape(value)}"
        raise ValueError(f"{found}: must be {expected}") from None


def require_key(key: object) -> None:
    """A value is one random key, of `jax.random.key` or of the older `jax.random.PRNGKey`."""
    expected = "must be one key, as from jax.random.key"
    if not isinstance(key, jax.Array | np.ndarray):
        raise ValueError(f"key = {shown(key)}: {expected}(0)")
    is_key = jnp.issubdtype(key.dtype, jax.dtypes.prng_key)
    if not is_key and (key.dtype != jnp.uint32 or key.ndim == 0):
        raise ValueError(f"key of {key.dtype}{[*key.shape]}: {expected}(0)")
    number = key.shape if is_key else key.shape[:-1]
    if number:
        raise ValueError(f"key holds {number} keys: {expected}; use jax.vmap for a batch")


def require_index(name: str, value: object, number: int) -> None:
    """All numbers are indices of a sequence of some length."""
    expected = f"must be a whole number from 0 to {number - 1}"
    dtype = jnp.result_type(value)
    if not jnp.issubdtype(dtype, jnp.integer):
        raise ValueError(f"{name} of dtype {dtype}: {expected}")
    require(name, value, lambda x: (x >= 0) & (x < number), expected)


def require_modality(modality: object, modalities: Sequence[str]) -> None:
    """A modality is an index; the error lists the indices with their names."""
    if isinstance(modality, bool | float) or modality not in range(len(modalities)):
        expected = " or ".join(f"{m} ({name})" for m, name in enumerate(modalities))
        raise ValueError(f"modality = {shown(modality)}: must be {expected}")


def require_number(name: str, value: object) -> None:
    """A value is one whole number greater than 0."""
    if not isinstance(value, int | np.integer) or isinstance(value, bool) or value < 1:
        raise ValueError(f"{name} = {shown(value)}: must be a whole number greater than 0")


def require_type(name: str, value: object, kind: type, source: str) -> None:
    """A value is of a class; `source` says where such values come from."""
    if not isinstance(value, kind):
        raise ValueError(f"{name} = {shown(value)}: must be {kind.__name__}, {source}")


def typed(function: Callable[P, T]) -> Callable[P, T]:
    """Decorator: arguments are of the dataclasses and protocols of their annotations."""
    hints, signature = get_type_hints(function), inspect.signature(function)

    @functools.wraps(function)
    def checked(*args: P.args, **kwargs: P.kwargs) -> T:
        for name, value in signature.bind(*args, **kwargs).arguments.items():
            kind = hints.get(name)
            if name == "key":
                require_key(value)
            elif isinstance(kind, type) and dataclasses.is_dataclass(kind):
                require_type(name, value, kind, f"of {kind.__module__}")
            elif isinstance(kind, type) and Protocol in kind.__bases__:
                require_members(name, value, kind)
        return function(*args, **kwargs)

    return checked


def require_belief(name: str, belief: Belief, size: int | None = None) -> None:
    """A belief is of one PoI, finite and wide, with `size` dimensions or any."""
    require_type(name, belief, Belief, "with mean and std")
    require_shape(f"{name}.mean", belief.mean, (size,))
    require_shape(f"{name}.std", belief.std, np.shape(belief.mean))
    require_finite(f"{name}.mean", belief.mean)
    require_positive(f"{name}.std", belief.std)


def require_members(name: str, value: object, protocol: type) -> None:
    """A value has the members of a protocol."""
    if isinstance(value, type):
        raise ValueError(f"{name} = {value.__name__}: must be a {protocol.__name__}, not its class")
    members = [member for member in vars(protocol) if not member.startswith("_")]
    missing = [member for member in members if not hasattr(value, member)]
    if missing:
        kind, expected = type(value).__name__, f"must be a {protocol.__name__}"
        raise ValueError(f"{name} = {kind}: {expected}; it lacks {', '.join(missing)}")


def require_one_each(name: str, values: object, modalities: Sequence[str]) -> None:
    """Each modality has one value."""
    expected = f"{len(modalities)}, one for each of {tuple(modalities)}"
    if not isinstance(values, Sequence | jax.Array | np.ndarray) or isinstance(values, str):
        raise ValueError(f"{name} = {shown(values)}: must hold {expected}")
    if len(values) != len(modalities):
        raise ValueError(f"{name} has {len(values)} entries: must be {expected}")
