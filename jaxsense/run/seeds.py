"""Several seeds: the means and intervals of what their summaries hold."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy.stats

_CONFIDENCE = 0.95


def statistics(summaries: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Mean and confidence of every figure of several summaries.

    Args:
      summaries: the blocks of several runs, of the same structure; two or more.

    Returns:
      The same structure, with `{"mean", "low", "high"}` in place of every number: the mean and the
      95% interval of it by Student's t. Left out is what not every run has, and what is neither a
      number nor holds numbers; in a list, None takes its place.
    """
    return _statistics(list(summaries)) or {}


def totals(timings: Sequence[dict[str, dict[str, float]]]) -> dict[str, dict[str, float]]:
    """The seconds of each stage of several runs together."""
    found: dict[str, dict[str, float]] = {}
    for timing in timings:
        for stage, seconds in timing.items():
            entry = found.setdefault(stage, dict.fromkeys(seconds, 0.0))
            for kind, value in seconds.items():
                entry[kind] += value
    return found


def _statistics(values: list[Any]) -> Any:
    first = next((value for value in values if value is not None), None)
    if isinstance(first, dict):
        names = [name for name in first if all(isinstance(v, dict) and name in v for v in values)]
        found = {name: _statistics([v[name] for v in values]) for name in names}
        return {name: value for name, value in found.items() if value is not None}
    if isinstance(first, list):
        return [_statistics(list(row)) for row in zip(*values, strict=True)]
    if isinstance(first, bool | int | float):
        return None if None in values else _interval(np.array(values, float))
    return None


def _interval(values: np.ndarray) -> dict[str, float]:
    mean = float(values.mean())
    error = float(scipy.stats.sem(values)) if len(values) > 1 else 0.0
    low, high = mean, mean
    if error > 0:
        low, high = scipy.stats.t.interval(_CONFIDENCE, len(values) - 1, loc=mean, scale=error)
    return {"mean": mean, "low": float(low), "high": float(high)}
