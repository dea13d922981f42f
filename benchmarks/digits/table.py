"""The table of all models, from the JSON that `python -m benchmarks.digits --json` has written."""

import statistics
from collections.abc import Mapping, Sequence
from typing import Any

from scipy import stats

from benchmarks.measure import describe

_DIGITS = {"log-likelihood": 1, "seconds": 1, "seconds compiling": 1}
_TIMES = "seconds", "seconds compiling"
_NOISY = "seconds"  # of a machine that others may use: medians, and ratios of the same seed


def of_results(results: Mapping[str, Any]) -> str:
    """Means over the trainings, with the half-widths of their 95% intervals, and how they came.

    Seconds are medians, and from the lowest to the highest training.

    Args:
      results: the content of the JSON file.
    """
    models: Mapping[str, list[dict[str, float]]] = results["models"]
    pair = [*models][:2]
    heads = [*models, *([f"{pair[0]} minus {pair[1]}, same seed"] if len(pair) > 1 else [])]
    lines = [f"| | {' | '.join(heads)} |", f"| ---{' | ---' * len(heads)} |"]
    for figure in next(iter(models.values()))[0]:
        of_each = [[run[figure] for run in runs] for runs in models.values()]
        cell = _median if figure == _NOISY else _cell
        cells = [cell(values, _DIGITS.get(figure, 3)) for values in of_each]
        if pair[1:]:
            gaps = (
                [x - y for x, y in zip(*of_each[:2], strict=True)] if figure not in _TIMES else []
            )
            cells.append(_cell(gaps, 1 + _DIGITS.get(figure, 3)) if gaps else "")
        lines.append(f"| {figure} | {' | '.join(cells)} |")
        if figure == _NOISY:
            ours = of_each[0]
            ratios = [[x / y for x, y in zip(each, ours, strict=True)] for each in of_each]
            cells = [_median(values, 1) for values in ratios] + [""] * len(pair[1:])
            lines.append(
                f"| ... over those of {next(iter(models))}, same seed | {' | '.join(cells)} |"
            )
    of = results["budget"]
    number = len(next(iter(models.values())))
    settings = (
        f"{number} trainings of each model. Latent size {of['latent_size']}; hidden layers "
        f"{', '.join(map(str, of['hidden']))}; variance {of['variance']}; alpha {of['alpha']}; "
        f"batch {of['batch']}; learning rate {of['learning_rate']}, falling along a cosine."
    )
    return "\n".join([*lines, "", settings, "", describe(results)])


def _median(values: Sequence[float], digits: int) -> str:
    low, middle, high = (f"{f(values):.{digits}f}" for f in (min, statistics.median, max))
    return middle if low == high else f"{middle} ({low} to {high})"


def _cell(values: Sequence[float], digits: int) -> str:
    mean = statistics.fmean(values)
    if len(set(values)) < 2:  # one training, or the same value for all
        return f"{mean:.{digits}f}" if mean else ""
    half = stats.sem(values) * stats.t.ppf(0.975, len(values) - 1)
    return f"{mean:.{digits}f} ± {half:.{digits}f}"
