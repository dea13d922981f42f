"""Means and intervals over several seeds."""

from collections.abc import Sequence
from typing import cast

import numpy as np

from jaxsense.summary.blocks import Results, Summary, Timing
from jaxsense.summary.compare import interval
from jaxsense.summary.read import RESULTS


def of_seeds(runs: Sequence[Summary]) -> tuple[Timing, dict[str, Results], Results]:
    """Summarises finished runs of several seeds.

    Args:
      runs: their summaries.

    Returns:
      The sums of their times, the results of each seed, and their means, see `statistics`.
    """
    total: Timing = {"total_s": sum(run["timing"]["total_s"] for run in runs), "stages": {}}
    for run in runs:
        for name, stage in run["timing"]["stages"].items():
            sums = total["stages"].setdefault(name, {"compile_s": 0.0, "run_s": 0.0})
            sums["compile_s"] += stage["compile_s"]
            sums["run_s"] += stage["run_s"]
    results = [cast(Results, {name: run[name] for name in RESULTS}) for run in runs]
    of_each = {str(run["seed"]): result for run, result in zip(runs, results, strict=True)}
    return total, of_each, statistics(results)


def statistics(results: Sequence[Results]) -> Results:
    """Mean and 95% interval of every number in the results of several runs.

    Args:
      results: of one or more runs, with the same structure.

    Returns:
      The same structure with an `Interval` in place of each number, and None where some run has
      None. Omits what some run lacks and what is not a number; in a list, None takes its place.
    """
    return cast(Results, _statistics(list(results)))


def _statistics(values: Sequence[object]) -> object:
    first = next((value for value in values if value is not None), None)
    if isinstance(first, dict):
        blocks = [value if isinstance(value, dict) else {} for value in values]
        names = [name for name in first if all(name in block for block in blocks)]
        columns = {name: [block[name] for block in blocks] for name in names}
        found = {name: _statistics(column) for name, column in columns.items()}
        return {name: x for name, x in found.items() if x is not None or None in columns[name]}
    if isinstance(first, list):
        lists = [value for value in values if isinstance(value, list)]
        return [_statistics(row) for row in zip(*lists, strict=True)]
    if isinstance(first, int | float) and None not in values:
        return interval(np.array(values, float))
    return None
