"""Sections of the settings: frozen dataclasses that are also pytrees.

Numbers that only enter the arithmetic are leaves, inputs of a compiled program; everything that
shapes a program is structure.
"""

import dataclasses
from collections.abc import Callable
from typing import Annotated, Any, ClassVar, TypeVar, dataclass_transform, get_type_hints

import jax
import numpy as np
from jax.core import Tracer

from jaxsense.config.checks import UNKNOWN, check_fields
from jaxsense.core.types import register

T = TypeVar("T")

_ARRAYS = jax.Array | jax.ShapeDtypeStruct
_LEAF = "leaf"
Traced = Annotated[T, _LEAF]
"""A setting that only enters the arithmetic: a number, or a JAX array, traced or not."""


@dataclass_transform(frozen_default=True)
class Checked:
    """Base of frozen dataclasses that check their fields when they are made.

    A subclass states its name as in `class LidarConfig(Section, place="lidar")`; error messages
    show it before the name of a field.
    """

    PLACE: ClassVar[str] = ""

    def __init_subclass__(cls, place: str = "") -> None:
        cls.PLACE = place
        dataclasses.dataclass(frozen=True)(cls)

    def __post_init__(self):
        check_fields(self)
        self.check()

    def check(self) -> None:
        """Checks relations between fields.

        Raises:
          ConfigError: if one does not hold.
        """


class Section(Checked):
    """Base of the sections: a pytree whose leaves are the fields declared `Traced`, and sections.

    A traced value passes its own checks, and relations with other fields.
    """

    _LEAVES: ClassVar[tuple[str, ...]] = ()

    def __init_subclass__(cls, place: str = "") -> None:
        super().__init_subclass__(place)
        hints = get_type_hints(cls, include_extras=True)
        names = [field.name for field in dataclasses.fields(cls)]
        cls._LEAVES = tuple(name for name in names if _is_leaf(hints[name]))
        register(cls, cls._LEAVES, [name for name in names if name not in cls._LEAVES])

    def __post_init__(self):
        # Of an array with axes, the extremes are checked.
        for extreme in (np.min, np.max):
            known = _known(self, extreme)
            check_fields(known)
            known.check()
        for name, value in vars(self).items():
            if not any(isinstance(leaf, _ARRAYS) for leaf in jax.tree.leaves(value)):
                object.__setattr__(self, name, getattr(known, name))


def _is_leaf(kind: object) -> bool:
    """Whether a field holds leaves: it is declared `Traced` or is a section."""
    is_section = isinstance(kind, type) and issubclass(kind, Section)
    return is_section or _LEAF in getattr(kind, "__metadata__", ())


def _known(value: Any, extreme: Callable[..., np.generic]) -> Any:
    """A value of the settings, one number for each array, with `UNKNOWN` for those without."""
    if isinstance(value, Section):
        known = object.__new__(type(value))
        for name, each in vars(value).items():
            object.__setattr__(
                known, name, _known(each, extreme) if name in value._LEAVES else each
            )
        return known
    if isinstance(value, tuple):
        return tuple(_known(each, extreme) for each in value)
    if isinstance(value, jax.Array) and not isinstance(value, Tracer) and value.size:
        return extreme(np.asarray(value)).item()
    return UNKNOWN if isinstance(value, _ARRAYS) else value
