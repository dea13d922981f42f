"""Sections of the settings: frozen dataclasses that are also pytrees.

Numbers that only enter the arithmetic are leaves, inputs of a compiled program; everything that
shapes a program is structure.
"""

import dataclasses
from typing import Annotated, ClassVar, NamedTuple, TypeVar, dataclass_transform, get_type_hints

import jax
import numpy as np

from jaxsense.config.checks import check_fields

T = TypeVar("T")

_LEAF = "leaf"
Traced = Annotated[T, _LEAF]
"""A setting that only enters the arithmetic: a number, or a JAX array, traced or not."""


class Sizes(NamedTuple):
    """Sizes of arrays that follow from several sections."""

    pois: int
    """PoIs in a mission."""
    classes: int
    """Classes of PoIs."""
    modalities: int
    """Trained modalities."""
    labels: int
    """Labels of all modalities."""
    window: int
    """Numbers in the largest window, or in its frame if the JMVAE learns from scans."""
    together: int
    """Looks by each sensor at a PoI that are surveyed together."""
    state: int
    """Numbers in a state of the MDP."""


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

    Sections that hold arrays or JAX's placeholders are not checked: these have no values yet.
    """

    _LEAVES: ClassVar[tuple[str, ...]] = ()

    def __init_subclass__(cls, place: str = "") -> None:
        super().__init_subclass__(place)
        hints = get_type_hints(cls, include_extras=True)
        names = [field.name for field in dataclasses.fields(cls)]
        cls._LEAVES = tuple(name for name in names if _is_leaf(hints[name]))
        others = [name for name in names if name not in cls._LEAVES]
        jax.tree_util.register_dataclass(cls, data_fields=cls._LEAVES, meta_fields=others)

    def __post_init__(self):
        if all(map(_is_plain, jax.tree.leaves([getattr(self, name) for name in self._LEAVES]))):
            super().__post_init__()

    def arrays(self, sizes: Sizes) -> dict[str, int]:
        """How many numbers each large array holds, by the fields that determine its size."""
        return {}


def _is_leaf(kind: object) -> bool:
    """Whether a field holds leaves: it is declared `Traced` or is a section."""
    is_section = isinstance(kind, type) and issubclass(kind, Section)
    return is_section or _LEAF in getattr(kind, "__metadata__", ())


def _is_plain(value: object) -> bool:
    """Whether a value is Python's or NumPy's, not a placeholder of JAX."""
    is_of_python = type(value).__module__ == "builtins" and type(value) is not object
    return is_of_python or isinstance(value, np.generic)
