"""Comparisons of policies that played in the same arenas."""

from typing import Any

import numpy as np
import scipy.special

REFERENCE = "latent"
"""The policy that the others are compared with."""

_CONFIDENCE = 0.95
_NAIVE = ("naive", "naive_2", "naive_3")


def interval(values: np.ndarray) -> tuple[Any, Any]:
    """The 95% interval of the mean of `[K, ...]` values, by Student's t; None of a single one."""
    if len(values) == 1:
        return None, None
    average = values.mean(axis=0)
    error = values.std(axis=0, ddof=1) / np.sqrt(len(values))
    # `scipy.stats`, which calls the same function, takes a third of a second to import.
    error = error * scipy.special.stdtrit(len(values) - 1, (1 + _CONFIDENCE) / 2)
    return average - error, average + error


def described(values: np.ndarray) -> dict[str, float | None]:
    """The mean of `[K]` values and its 95% interval, see `interval`."""
    low, high = (None if end is None else float(end) for end in interval(values))
    return {"mean": float(values.mean()), "low": low, "high": high}


def differences(
    found: dict[str, Any], reference: dict[str, Any]
) -> dict[str, dict[str, float | None]]:
    """Mean differences of one case from another, arena by arena, with their 95% intervals.

    Args:
      found: `[E, ...]` metrics of the case, see `mission.measure`.
      reference: of the other case, in the same arenas.
    """

    def of_missions(metrics: dict[str, Any]) -> dict[str, np.ndarray]:
        return {
            "accuracy": metrics["is_right"].mean(axis=-1),
            "observations_per_poi": metrics["observations_per_poi"],
            "time_s": metrics["time_s"],
        }

    own, other = of_missions(found), of_missions(reference)
    return {name: described(np.asarray(own[name] - other[name], float)) for name in own}


def of_naive(blocks: dict[str, dict[str, Any]], name: str) -> dict[str, float] | None:
    """Looks and time of a policy over those of naive exploration of the same accuracy.

    Between one, two and three looks of each robot at each PoI, naive exploration is interpolated
    linearly. More looks that are no more accurate do not count. A policy that is more accurate than
    all of these is compared with the most accurate one: naive exploration would need even more.

    Args:
      blocks: of the summary, for every case that was played.
      name: of the policy.

    Returns:
      The ratios of looks, of median times and of mean times; None if naive exploration was not
      played, or is more accurate with fewer looks.
    """
    if not {name, *_NAIVE} <= set(blocks):
        return None
    naive = [blocks[_NAIVE[0]]]
    for each in _NAIVE[1:]:
        if blocks[each]["accuracy"] > naive[-1]["accuracy"]:
            naive.append(blocks[each])
    accuracies = [block["accuracy"] for block in naive]
    if blocks[name]["accuracy"] < accuracies[0]:
        return None
    return {
        key: float(
            blocks[name][key]
            / np.interp(blocks[name]["accuracy"], accuracies, [block[key] for block in naive])
        )
        for key in ("observations_per_poi", "time_s", "mean_time_s")
    }


def compared(blocks: dict[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """Blocks of the summary with the comparisons that hold: between cases in the same arenas.

    `of_naive` is computed anew. `intervals`, which need every mission, stay or are left out.
    """

    def compare(name: str, block: dict[str, Any]) -> dict[str, Any]:
        beside = {n: other for n, other in blocks.items() if arenas(other) == arenas(block)}
        stale = {"of_naive"} if REFERENCE in beside else {"of_naive", "intervals"}
        kept = {key: value for key, value in block.items() if key not in stale}
        ratios = of_naive(beside, name)
        return kept if ratios is None else {**kept, "of_naive": ratios}

    return {name: compare(name, block) for name, block in blocks.items()}


def arenas(block: dict[str, Any]) -> tuple[Any, Any]:
    """The seed, None in a run's own blocks, and the number of the arenas of a case."""
    return block.get("seed"), block["episodes"]
