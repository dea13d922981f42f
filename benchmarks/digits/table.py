"""The table of all models, from the JSON that `python -m benchmarks.digits --json` has written."""

import statistics
from collections.abc import Mapping, Sequence
from typing import Any

from scipy import stats

from benchmarks.measure import describe

_DIGITS = {"log-likelihood": 1, "seconds": 1, "seconds compiling": 1}


def of_results(results: Mapping[str, Any]) -> str:
    """Means over the trainings, with the half-widths of their 95% intervals, and how they came.

    Args:
      results: the content of the JSON file.
    """
    models: Mapping[str, list[dict[str, float]]] = results["models"]
    lines = [f"| | {' | '.join(models)} |", f"| ---{' | ---' * len(models)} |"]
    for figure in next(iter(models.values()))[0]:
        of_each = [[run[figure] for run in runs] for runs in models.values()]
        cells = [_cell(values, _DIGITS.get(figure, 3)) for values in of_each]
        lines.append(f"| {figure} | {' | '.join(cells)} |")
    return "\n".join([*lines, "", describe(results)])


def _cell(values: Sequence[float], digits: int) -> str:
    mean = statistics.fmean(values)
    if len(set(values)) < 2:  # one training, or the same value for all
        return f"{mean:.{digits}f}" if mean else ""
    half = stats.sem(values) * stats.t.ppf(0.975, len(values) - 1)
    return f"{mean:.{digits}f} ± {half:.{digits}f}"
