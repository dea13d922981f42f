"""Tables of `benchmarks.imperfect`: break points, and figures at all sizes of an error."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from benchmarks import studies
from benchmarks.same_accuracy import Need
from benchmarks.where import as_cell

NO_SEARCH, SEARCH, MESSAGES = "no search", "with a search", "messages"
"""Names of the curves."""
KEYS = {"accuracy": 3, "own": 3, "nll": 3, "looks": 2, "time": 1, "collisions": 3}
"""What is measured, with its decimals in tables."""
_HEADS = {
    "accuracy": "accuracy",
    "own": "accuracy of the robots' own maps",
    "nll": "NLL",
    "looks": "looks per PoI",
    "time": "mean time [s]",
}
_OF_SIZES = ("accuracy", "looks", "time")
_OF_MESSAGES = ("accuracy", "own", "nll", "looks", "time")


def breaks(results: Mapping[str, Any]) -> str:
    """Sizes of each error at which the accuracy has fallen by `imperfect.FALL`, in Markdown.

    Args:
      results: the content of the JSON file.
    """
    curves = _by_sweep(results, (NO_SEARCH, SEARCH))
    rows = [
        [sweep, *(point_in_words(found[sweep]["break"]) for found in curves.values())]
        for sweep in next(iter(curves.values()))
    ]
    return studies.with_origin(studies.as_table(["error", *curves], rows), results)


def of_sizes(results: Mapping[str, Any], sweeps: Sequence[str]) -> str:
    """Figures without a search and with one at all sizes of some errors, in Markdown.

    Args:
      results: the content of the JSON file.
      sweeps: names of the errors.
    """
    curves = _by_sweep(results, (NO_SEARCH, SEARCH))
    heads = [f"{_HEADS[key]}, {name}" for name in curves for key in _OF_SIZES]
    none = [f"{results['usual'][key]:.{KEYS[key]}f}" for key in _OF_SIZES]
    rows = [["none", *none * len(curves)]]
    for sweep in sweeps:
        for i, row in enumerate(next(iter(curves.values()))[sweep]["rows"]):
            each = [found[sweep]["rows"][i] for found in curves.values()]
            cells = [as_cell(row[key], KEYS[key]) for row in each for key in _OF_SIZES]
            rows.append([f"{sweep}: {row['size']:g}", *cells])
    return studies.with_origin(studies.as_table(["error", *heads], rows), results)


def of_messages(results: Mapping[str, Any]) -> str:
    """Figures at the largest loss and delay of each kind, in Markdown.

    Args:
      results: the content of the JSON file.
    """
    usual = results["usual"]
    none = [f"{usual[key]:.{KEYS[key]}f}" for key in _OF_MESSAGES]
    rows = [["one shared map", *none, ""]]
    for found in results["curves"][MESSAGES]:
        row = found["rows"][-1]
        cells = [as_cell(row[key], KEYS[key]) for key in _OF_MESSAGES]
        ratio = row["time"][0] / usual["time"]
        rows.append([f"{found['sweep']}: {row['size']:g}", *cells, f"{ratio:.3f}"])
    heads = ["messages", *(_HEADS[key] for key in _OF_MESSAGES), "ratio of mean times"]
    return studies.with_origin(studies.as_table(heads, rows), results)


def _by_sweep(
    results: Mapping[str, Any], names: Iterable[str]
) -> dict[str, dict[str, Mapping[str, Any]]]:
    """Those of some curves that were measured, their sweeps by name."""
    return {
        name: {each["sweep"]: each for each in results["curves"][name]}
        for name in names
        if name in results["curves"]
    }


def tables(results: Mapping[str, Any]) -> Iterator[str]:
    """All tables of a JSON file.

    Args:
      results: its content.
    """
    for found in _by_sweep(results, (NO_SEARCH,)).values():
        yield breaks(results)
        yield of_sizes(results, [*found])
    if MESSAGES in results["curves"]:
        yield of_messages(results)


def point_in_words(point: Need | None) -> str:
    """A break point with its interval, as tables show it.

    Args:
      point: None if there is none.
    """
    if point is None:
        return "-"
    mean, low, high = ("?" if x is None else f"{x:.3g}" for x in point.values())
    return f"{mean} ({low} to {high})"
