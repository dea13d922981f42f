"""Numbers of `summary.json`, their names and their text."""

import dataclasses
from collections.abc import Mapping
from typing import TypedDict


class Interval(TypedDict):
    """A mean and its 95% interval by Student's t; a single value has no interval."""

    mean: float
    low: float | None
    high: float | None


Number = float | Interval
"""A number of a run, or the mean and the interval of several seeds."""


@dataclasses.dataclass(frozen=True)
class Metric:
    """One value of a block.

    Attributes:
      label: its name.
      meaning: what it measures; empty if the label is enough.
      digits: after the point.
      key: its place in the block, which names it; a dot leads into an inner block.
    """

    label: str
    meaning: str = ""
    digits: int = 3
    key: str = ""

    def value(self, block: Mapping[str, object]) -> object:
        """Its value in a block; None if there is none."""
        value: object = block
        for part in self.key.split("."):
            value = value.get(part) if isinstance(value, Mapping) else None
        return value

    def text(self, block: Mapping[str, object]) -> str:
        """Its value in a block as text, see `text`."""
        return text(self.value(block), self.digits)


def mean(value: Number) -> float:
    """A number, or the mean of several seeds."""
    return value if isinstance(value, int | float) else value["mean"]


def text(value: object, digits: int = 3) -> str:
    """A number, with its interval, which no line breaks, if it has one; a hyphen for None.

    Args:
      value: a number, a `Number` of several seeds, or None.
      digits: after the point; whole numbers have none.
    """
    if isinstance(value, Mapping):
        middle, low, high = (text(value.get(name), digits) for name in ("mean", "low", "high"))
        return middle if low == "-" else f"{middle} ({low}\u00a0to\u00a0{high})"
    if isinstance(value, float):
        return f"{round(value, digits) + 0.0:,.{digits}f}"  # no "-0.00"
    return f"{value:,}" if isinstance(value, int) else "-"
