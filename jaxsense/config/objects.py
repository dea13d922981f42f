"""What points of interest can look like: names for colours, shapes and attributes of one's own."""

import dataclasses
import math
import re
from collections.abc import Mapping
from typing import Literal

from jaxsense.config.checks import ConfigError, require, require_choices

LEAST_SHARE = 0.5
"""Smallest half side of a shape: of a narrower one a sensor may miss what it believes it faces."""


@dataclasses.dataclass(frozen=True)
class Shape:
    """An upright solid of the ray-caster, as high as all PoIs."""

    primitive: Literal["cylinder", "box"]
    """The solid."""
    half_sides: tuple[float, float] = (1.0, 1.0)
    """Half the sides of a box, or the radius of a cylinder twice, as shares of arena.poi_radius
    from 0.5 to 1."""

    def __post_init__(self):
        require_choices(self)
        require(
            len(self.half_sides) == 2 and all(LEAST_SHARE <= s <= 1 for s in self.half_sides),
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
    """A number that PoIs have beside colour and shape, for example a temperature."""

    values: dict[str, float] = dataclasses.field(hash=False)
    """For each word that a class can have, the number that it stands for."""
    elsewhere: float = 0.0
    """The number of walls and robots."""

    def __post_init__(self):
        require_words(self.values, "attribute.values")
        numbers = (*self.values.values(), self.elsewhere)
        require(all(map(math.isfinite, numbers)), self, "values", "must be finite numbers")


COLOURS: dict[str, tuple[float, float, float]] = {
    "red": (0.8, 0.1, 0.1),
    "green": (0.1, 0.7, 0.1),
    "blue": (0.1, 0.2, 0.8),
    "yellow": (0.8, 0.7, 0.1),
}
"""The colours that are known from the start: albedo, linear RGB in [0, 1]."""

SHAPES: dict[str, Shape] = {"cylinder": Shape("cylinder"), "cube": Shape("box")}
"""The shapes that are known from the start."""


def require_words(named: Mapping[str, object], field: str) -> None:
    """Raises `ConfigError` unless there are names, and each is one word."""
    for name in named:
        if not re.fullmatch(r"[\w-]+", name):
            raise ConfigError(field, name, "must be a word of letters, digits, - and _")
    if not named:
        raise ConfigError(field, named, "must name one or more")
