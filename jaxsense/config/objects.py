"""Colours, shapes and custom attributes of points of interest."""

import re
from collections.abc import Mapping
from typing import Literal

from jaxsense.config.checks import ConfigError, limited, require
from jaxsense.config.frozen import FrozenDict
from jaxsense.config.section import Checked

_MIN_SHARE = 0.5  # sensors may miss a narrower shape that they face
_MAX_NAME = 64  # letters; it becomes part of the names of files


class Shape(Checked, place="shape"):
    """A shape of PoIs: an upright cylinder or box, `arena.poi_height` high."""

    primitive: Literal["cylinder", "box"]
    """The solid."""
    half_sides: tuple[float, float] = limited((1.0, 1.0), at_least=_MIN_SHARE, at_most=1)
    """Half the sides of a box, or the radius of a cylinder twice, as shares of arena.poi_radius
    from 0.5 to 1."""

    def check(self) -> None:
        """Checks that a cylinder is round; raises `ConfigError`."""
        fits = not self.is_round or self.half_sides[0] == self.half_sides[1]
        require(fits, self, "half_sides", "must be the same number twice for a cylinder")

    @property
    def is_round(self) -> bool:
        """Whether it is a cylinder."""
        return self.primitive == "cylinder"

    @property
    def at_any_yaw(self) -> tuple[str | float, ...]:
        """What sensors can distinguish it by, as a PoI may have any yaw."""
        return self.primitive, *sorted(self.half_sides)


class Attribute(Checked, place="attribute"):
    """A numeric property of each PoI besides colour and shape, for example its temperature."""

    values: Mapping[str, float]
    """Number of each word that a class can have."""
    elsewhere: float = 0.0
    """The number of walls and robots."""

    def check(self) -> None:
        """Checks the words; raises `ConfigError`."""
        require_words(self.values, "attribute.values")
        require(len(self.values) > 0, self, "values", "must name one or more")


COLOURS: Mapping[str, tuple[float, float, float]] = FrozenDict(
    {
        "red": (0.8, 0.1, 0.1),
        "green": (0.1, 0.7, 0.1),
        "blue": (0.1, 0.2, 0.8),
        "yellow": (0.8, 0.7, 0.1),
    }
)
"""Built-in colours: albedo, linear RGB in [0, 1]."""

SHAPES: Mapping[str, Shape] = FrozenDict({"cylinder": Shape("cylinder"), "cube": Shape("box")})
"""Built-in shapes of PoIs."""


def require_words(names: Mapping[str, object], field: str) -> None:
    """Checks that each name is one word.

    Args:
      names: a dictionary from names.
      field: the setting.

    Raises:
      ConfigError: if a name is something else.
    """
    for name in names:
        if not re.fullmatch(rf"[\w-]{{1,{_MAX_NAME}}}", name):
            reason = f"must be a word of 1 to {_MAX_NAME} letters, digits, - and _"
            raise ConfigError(field, name, reason)
