"""Means over seeds, and the table of all fusions."""

from collections.abc import Mapping
from typing import Any, TypedDict

import numpy as np
from scipy import stats

from benchmarks.measure import describe

REFERENCE = "filter"
"""The fusion that the others are compared with."""

Figures = Mapping[str, float]
"""What is measured of one fusion and one seed, by name."""

_DIGITS = {"looks": 2, "seconds": 1}


class Interval(TypedDict):
    """A mean over seeds and its 95% interval, which one seed does not have."""

    mean: float
    low: float | None
    high: float | None


class OfFusion(TypedDict):
    """Means over seeds, and mean differences from `filter`, paired by seed, by figure."""

    bytes: int
    mean: dict[str, Interval]
    less_filter: dict[str, Interval]


def means(
    found: Mapping[int, Mapping[str, Figures]], name: str, less: str | None = None
) -> dict[str, Interval]:
    """Means over seeds by figure, with their intervals.

    Args:
      found: figures of each seed and fusion.
      name: of the fusion.
      less: name of a fusion whose figures are subtracted, seed by seed.
    """

    def of(figure: str) -> Interval:
        values = [x[name][figure] - (x[less][figure] if less else 0.0) for x in found.values()]
        low = high = None
        if len(values) > 1:
            low, high = map(float, stats.ttest_1samp(values, 0.0).confidence_interval(0.95))
        return {"mean": float(np.mean(values)), "low": low, "high": high}

    return {figure: of(figure) for figure in next(iter(found.values()))[name]}


def summarise(
    found: Mapping[int, Mapping[str, Figures]], sizes: Mapping[str, int]
) -> dict[str, OfFusion]:
    """Summarises seeds.

    Args:
      found: figures of each seed and fusion.
      sizes: bytes of a belief of each fusion, in the order of the table.
    """
    return {
        name: {
            "bytes": size,
            "mean": means(found, name),
            "less_filter": means(found, name, less=REFERENCE),
        }
        for name, size in sizes.items()
    }


def as_markdown(fusions: Mapping[str, OfFusion]) -> str:
    """The table of all figures and fusions, to paste into a page.

    Args:
      fusions: from `summarise`.
    """
    rows = [
        ["", *fusions],
        ["---"] * (1 + len(fusions)),
        ["bytes", *(str(each["bytes"]) for each in fusions.values())],
    ]
    for figure in fusions[REFERENCE]["mean"]:
        cells = [_cell(each, figure, name == REFERENCE) for name, each in fusions.items()]
        rows.append([figure, *cells])
    return "".join(f"| {' | '.join(row)} |\n" for row in rows)


def of_results(results: Mapping[str, Any]) -> str:
    """The table of a JSON file, and how it came.

    Args:
      results: the content of the file.
    """
    return f"{as_markdown(results['fusions'])}\n{describe(results)}"


def _cell(found: OfFusion, figure: str, is_reference: bool) -> str:
    """A mean, and the difference from `filter` with the half-width of its interval."""
    digits = _DIGITS.get(figure, 3)
    text = f"{found['mean'][figure]['mean']:.{digits}f}"
    if is_reference:
        return text
    less = found["less_filter"][figure]
    text += f", {less['mean']:+.{digits}f}"
    return text if less["high"] is None else f"{text} ± {less['high'] - less['mean']:.{digits}f}"
