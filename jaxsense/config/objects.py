"""Colours, shapes and custom attributes of points of interest."""

import dataclasses
import re
from collections.abc import Mapping
from typing import Literal

from jaxsense.config.checks import ConfigError, require, require_types

LEAST_SHARE = 0.5
"""Smallest half side of a shape; sensors may miss a narrower one that they face."""

_LONGEST_NAME = 64  # letters; it becomes part of the names of files


@dataclasses.dataclass(frozen=True)
class Shape:
    """An upright solid of the ray-caster, as high as all PoIs."""

    primitive: Literal["cylinder", "box"]
    """The solid."""
    half_sides: tuple[float, float] = (1.0, 1.0)
    """Half the sides of a box, or the radius of a cylinder twice, as shares of arena.poi_radius
    from 0.5 to 1."""

    def __post_init__(self):
        require_types(self)
        require(
            all(LEAST_SHARE <= share <= 1 for share in self.half_sides),
            self,
            "half_sides",
            f"must be two shares of poi_radius, each from {LEAST_SHARE} to 1",
        )
        require(
            self.primitive == "box" or self.half_sides[0] == self.half_sides[1],
            self,
            "half_sides",
            "must be the same number twice, for a cylinder is round",
        )


@dataclasses.dataclass(frozen=True)
class Attribute:
    """A number of each PoI besides colour and shape, for example a temperature."""

    values: dict[str, float] = dataclasses.field(hash=False)
    """Number of each word that a class can have."""
    elsewhere: float = 0.0
    """The number of walls and robots."""

    def __post_init__(self):
        require_types(self)
        require_words(self.values, "attribute.values")


COLOURS: dict[str, tuple[float, float, float]] = {
    "red": (0.8, 0.1, 0.1),
    "green": (0.1, 0.7, 0.1),
    "blue": (0.1, 0.2, 0.8),
    "yellow": (0.8, 0.7, 0.1),
}
"""Built-in colours: albedo, linear RGB in [0, 1]."""

SHAPES: dict[str, Shape] = {"cylinder": Shape("cylinder"), "cube": Shape("box")}
"""Built-in shapes."""


def require_words(named: Mapping[str, object], field: str) -> None:
    """Raises `ConfigError` unless there is a name, and each is one word."""
    for name in named:
        if not re.fullmatch(rf"[\w-]{{1,{_LONGEST_NAME}}}", name):
            reason = f"must be a word of 1 to {_LONGEST_NAME} letters, digits, - and _"
            raise ConfigError(field, name, reason)
    if not named:
        raise ConfigError(field, named, "must name one or more")
