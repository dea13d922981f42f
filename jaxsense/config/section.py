"""Sections of the settings: frozen dataclasses that are also pytrees.

Numbers that only enter the arithmetic are leaves, inputs of a compiled program; everything that
shapes a program is structure.
"""

import dataclasses
from typing import Annotated, Any, TypeVar, dataclass_transform, get_args, get_type_hints

import jax
import numpy as np

T = TypeVar("T")

_LEAF = "leaf"
Traced = Annotated[T, _LEAF]
"""A setting that only enters the arithmetic: a number, or a JAX array, traced or not."""


@dataclasses.dataclass(frozen=True)
class _Structure:
    """Settings of a section that are not leaves; equal if all of them are."""

    values: tuple[Any, ...]

    def __hash__(self) -> int:
        return hash(repr(self.values))  # a dictionary has no hash


@dataclass_transform(frozen_default=True)
def section(cls: type[T]) -> type[T]:
    """Makes a frozen dataclass and a pytree, whose leaves are the fields declared `Traced`.

    Sections of plain values call their method `check` when made; arrays and JAX's placeholders have
    no values to check.
    """

    def check(self: Any) -> None:
        if all(map(_is_plain, jax.tree.leaves([getattr(self, name) for name in leaves]))):
            self.check()

    cls.__post_init__ = check  # pyright: ignore[reportAttributeAccessIssue]
    made: Any = dataclasses.dataclass(frozen=True)(cls)
    hints = get_type_hints(made, include_extras=True)
    leaves = [field.name for field in dataclasses.fields(made) if _is_leaf(hints[field.name])]
    others = [field.name for field in dataclasses.fields(made) if field.name not in leaves]

    def flatten(value: Any) -> tuple[list[tuple[Any, Any]], _Structure]:
        children = [(jax.tree_util.GetAttrKey(name), getattr(value, name)) for name in leaves]
        return children, _Structure(tuple(getattr(value, name) for name in others))

    def unflatten(structure: _Structure, children: Any) -> Any:
        values = zip(others, structure.values, strict=True)
        return made(**dict(values), **dict(zip(leaves, children, strict=True)))

    jax.tree_util.register_pytree_with_keys(made, flatten, unflatten)
    return made


def _is_leaf(kind: Any) -> bool:
    """Whether a field holds leaves: it is declared `Traced` or is a section."""
    return _LEAF in get_args(kind)[1:] or hasattr(kind, "check")


def _is_plain(value: Any) -> bool:
    """Whether a value is Python's or NumPy's, not a placeholder of JAX."""
    is_of_python = type(value).__module__ == "builtins" and type(value) is not object
    return is_of_python or isinstance(value, np.generic)
