"""Compares policies that played in the same arenas, averages seeds, and says what they show."""

from collections.abc import Mapping, Sequence
from typing import cast, get_type_hints

import numpy as np
import scipy.special
from jaxtyping import PyTree

from jaxsense.mission.outcome import is_fault
from jaxsense.summary import blocks
from jaxsense.summary.blocks import Interval, Missions, Origin, Results, Summary, mean

REFERENCE = "latent"
"""The policy that the others are compared with."""

_AS_ACCURATE = 0.005
"""Difference of accuracies that does not matter when times and looks are compared."""

Measured = Mapping[str, PyTree[np.ndarray]]
"""`[E, ...]` metrics of the missions of a case, see `mission.outcome.measure`."""

UNKNOWN: Origin = {"versions": {}, "devices": []}
"""Origin of figures that do not tell it."""

_MADE_BY = ("devices", "cores", "source", "commit")
_MOST_TIMES, _MOST_NATS = 1.2, 0.01  # NLL of a sound map, of that of exact Bayes
_SMOKE = "Preset smoke only checks that everything runs: its policies are not meant to be good."
_AS_FAST = 0.005  # share of a time that does not matter


def bounds(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The 95% interval of the mean of `[K, ...]` values by Student's t; NaN if K is 1."""
    average = values.mean(axis=0)
    if len(values) == 1:
        return np.full_like(average, np.nan), np.full_like(average, np.nan)
    error = values.std(axis=0, ddof=1) / np.sqrt(len(values))
    # `scipy.stats`, which calls the same function, takes a third of a second to import.
    error = error * scipy.special.stdtrit(len(values) - 1, 0.975)
    return average - error, average + error


def interval(values: np.ndarray) -> Interval:
    """The mean of `[K]` values and its 95% interval, see `bounds`."""
    low, high = (None if np.isnan(end) else float(end) for end in bounds(values))
    return {"mean": float(values.mean()), "low": low, "high": high}


def differences(found: Measured, reference: Measured) -> blocks.Differences:
    """Mean differences of one case from another, arena by arena, with their 95% intervals."""
    own, other = (case["is_right"].mean(axis=-1) for case in (found, reference))
    looks, seconds = (
        interval(np.asarray(found[name] - reference[name], float))
        for name in ("observations_per_poi", "time_s")
    )
    return {"accuracy": interval(own - other), "observations_per_poi": looks, "time_s": seconds}


def of_seeds(runs: Sequence[Summary]) -> tuple[blocks.Timing, dict[str, Results], Results]:
    """The sums of the times of several seeds, the results of each, and their `statistics`."""
    total: blocks.Timing = {"total_s": sum(run["timing"]["total_s"] for run in runs), "stages": {}}
    for run in runs:
        for name, stage in run["timing"]["stages"].items():
            sums = total["stages"].setdefault(name, {"compile_s": 0.0, "run_s": 0.0})
            sums["compile_s"] += stage["compile_s"]
            sums["run_s"] += stage["run_s"]
    names = get_type_hints(Results)
    results = {str(run["seed"]): cast(Results, {n: run[n] for n in names}) for run in runs}
    return total, results, cast(Results, statistics([*results.values()]))


def statistics(values: Sequence[object]) -> object:
    """Mean and 95% interval of every number in several results of the same structure.

    Returns:
      The same structure with an `Interval` in place of each number, and None where some result has
      None. Omits what some result lacks and what is not a number; in a list, None takes its place.
    """
    first = next((value for value in values if value is not None), None)
    if isinstance(first, dict):
        dicts = [value if isinstance(value, dict) else {} for value in values]
        names = [name for name in first if all(name in each for each in dicts)]
        columns = {name: [each[name] for each in dicts] for name in names}
        found = {name: statistics(column) for name, column in columns.items()}
        return {name: x for name, x in found.items() if x is not None or None in columns[name]}
    if isinstance(first, list):
        lists = [value for value in values if isinstance(value, list)]
        return [statistics(row) for row in zip(*lists, strict=True)]
    if isinstance(first, int | float) and None not in values:
        return interval(np.array(values, float))
    return None


def unsound(block: blocks.Beliefs) -> str | None:
    """A warning if the map knows much less than exact Bayes after the same looks.

    None if the negative log-likelihood is at most 1.2 times that of exact Bayes plus 0.01 nats,
    after any number of looks.
    """
    rows = zip(block["looks"], block["nll"], block["bayes_nll"], strict=True)
    of_looks = [(int(mean(looks)), mean(nll), mean(bayes)) for looks, nll, bayes in rows]
    worse = [row for row in of_looks if not row[1] <= _MOST_TIMES * row[2] + _MOST_NATS]
    if not worse:
        return None
    looks, nll, bayes = max(worse, key=lambda row: row[1] - row[2])
    after = f"{looks} looks" if looks > 1 else "1 look"
    return (
        f"The map loses information: its NLL after {after} is {nll:.2f}, that of exact Bayes "
        f"{bayes:.2f}. Try jmvae.fusion = filter, a larger jmvae.latent_size, or more "
        "jmvae.restarts."
    )


def differences_of(origins: Sequence[Origin]) -> dict[str, list[str]]:
    """The values of code, versions and machines in which origins differ, by name."""
    found = [
        {**each["versions"], **{name: x for name, x in each.items() if name in _MADE_BY}}
        for each in origins
    ]
    names = dict.fromkeys(name for each in found for name in each)
    values = {name: [str(each.get(name, "unknown")) for each in found] for name in names}
    return {name: each for name, each in values.items() if len(set(each)) > 1}


def several_origins(origins: Sequence[Origin]) -> str | None:
    """Says in what the origins of a run differ; None if they do not."""
    parts = [
        f"{name} {' and '.join(dict.fromkeys(values))}"
        for name, values in differences_of(origins).items()
    ]
    return f"Stages of this run were made with different {', '.join(parts)}." if parts else None


def remarks(found: Summary) -> list[str]:
    """Sentences to keep in mind about all results of a run."""
    caution = unsound(found["belief"])
    if found["preset"] == "smoke":  # nobody wants to improve it
        caution = _SMOKE
    return [each for each in (several_origins(found.get("origins", ())), caution) if each]


def verdict(played: Missions) -> str | None:
    """Compares median times: the latent policy's, naive exploration's and the fastest policy's.

    Policies that are less often right do not count. None unless the first two were played.
    """
    if not {REFERENCE, "naive"} <= set(played):
        return None
    accuracy = {name: mean(case["accuracy"]) for name, case in played.items()}
    ratios = {
        name: mean(played[REFERENCE]["time_s"]) / mean(case["time_s"])
        for name, case in played.items()
    }

    def against(name: str) -> str:
        percent = 100 * (ratios[name] - 1)
        if abs(percent) < 100 * _AS_FAST:
            return f"as fast as {name}"
        return f"{abs(percent):.0f} % {'faster' if percent < 0 else 'slower'} than {name}"

    text = f"By median times, the latent policy is {against('naive')} exploration"
    faster = [
        name
        for name in played
        if not (is_fault(name) or name.startswith("naive"))
        and ratios[name] > 1 / (1 - _AS_FAST)
        and accuracy[name] > accuracy[REFERENCE] - _AS_ACCURATE
    ]
    if faster:
        text += f" (and {against(max(faster, key=lambda name: ratios[name]))})"
    return f"{text}."
