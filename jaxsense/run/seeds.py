"""Means and confidence intervals of the metrics of several seeds."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import scipy.stats

from jaxsense.config import Config
from jaxsense.run.checkpoints import Checkpoints

_CONFIDENCE = 0.95


def statistics(summaries: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Mean and confidence interval of every number in several summaries.

    Args:
      summaries: the blocks of two or more runs, of the same structure.

    Returns:
      The same structure, with `{"mean", "low", "high"}` in place of every number: the mean and its
      95% interval by Student's t. Omits what some run lacks and what is no number; in a list, None
      takes its place.
    """
    return _statistics(list(summaries)) or {}


def rewards(runs: Sequence[Path], config: Config) -> dict[str, np.ndarray]:
    """`[K, epochs]` mean total rewards for each modality, from the checkpoints of several runs."""
    shapes = {
        "reward": np.zeros(config.dqn.epochs, np.float32),
        "epsilon": np.zeros(config.dqn.epochs, np.float32),
        "seconds": np.zeros(config.dqn.epochs // config.dqn.chunk, np.float32),
    }

    def load(run: Path, modality: str) -> np.ndarray:
        name = f"curves_dqn_{modality}"
        return Checkpoints(run / "checkpoints").load(name, shapes)["reward"]

    return {name: np.stack([load(run, name) for run in runs]) for name in config.modalities}


def totals(timings: Sequence[dict[str, dict[str, float]]]) -> dict[str, dict[str, float]]:
    """Total seconds of each stage over several runs."""
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
        return None if None in values else _described(np.array(values, float))
    return None


def interval(values: np.ndarray) -> tuple[Any, Any]:
    """The 95% interval of the mean of `[K, ...]` values, by Student's t."""
    average = values.mean(axis=0)
    if len(values) == 1:
        return average, average
    error = scipy.stats.sem(values) * scipy.stats.t.ppf((1 + _CONFIDENCE) / 2, len(values) - 1)
    return average - error, average + error


def _described(values: np.ndarray) -> dict[str, float]:
    low, high = interval(values)
    return {"mean": float(values.mean()), "low": float(low), "high": float(high)}
