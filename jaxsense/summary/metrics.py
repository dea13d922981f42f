"""One metric of `summary.json`: its name, its meaning and its text."""

import dataclasses
from collections.abc import Mapping
from typing import TypedDict


class Interval(TypedDict):
    """A mean and its 95% interval by Student's t; no interval of a single value."""

    mean: float
    low: float | None
    high: float | None


Number = float | Interval
"""A number of a run, or the mean and the interval of several seeds."""


@dataclasses.dataclass(frozen=True)
class Metric:
    """What a value of `summary.json` is; see `blocks`.

    Attributes:
      label: its name.
      meaning: what it measures; empty if the label is enough.
      paper: the paper's value; with a star, the output of its authors' code.
      digits: after the point.
      key: its place in its block; a dot leads into an inner block.
    """

    label: str
    meaning: str = ""
    paper: str = ""
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
    """Formats a metric.

    Args:
      value: a number, a `Number` of several seeds, or None.
      digits: after the point; whole numbers have none.

    Returns:
      The number, with its interval if it has one; a hyphen for None.
    """
    if isinstance(value, Mapping):
        middle, low, high = (value.get(name) for name in ("mean", "low", "high"))
        # Also where all seeds agree, so that a column reads alike.
        around = "" if low is None else f" ({text(low, digits)} to {text(high, digits)})"
        middle = text(None if middle is None else float(middle), digits)
        return f"{middle}{around}"
    if isinstance(value, float):
        # No "-0.00"; and an interval's ends may be whole.
        return f"{round(value, digits) + 0.0:,.{digits}f}"
    return f"{value:,}" if isinstance(value, int) else "-"
