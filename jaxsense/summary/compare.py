"""Compares policies that played in the same arenas."""

from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np
import scipy.special
from jaxtyping import PyTree

from jaxsense.mission import is_fault
from jaxsense.summary.blocks import (
    Beliefs,
    Case,
    Differences,
    Missions,
    OfNaive,
    Origin,
    Summary,
    cases,
    traffic,
)
from jaxsense.summary.metrics import Interval, mean

REFERENCE = "latent"
"""The policy that the others are compared with."""

AS_ACCURATE = 0.005
"""Difference of accuracies that does not matter when times and looks are compared."""

Measured = Mapping[str, PyTree[np.ndarray]]
"""`[E, ...]` metrics of the missions of a case, see `mission.measure`."""

UNKNOWN: Origin = {"versions": {}, "devices": []}
"""Origin of figures that do not tell it."""

_MADE_BY = ("devices", "cores", "source", "commit")
_CONFIDENCE = 0.95
_NAIVE = ("naive", "naive_2", "naive_3")
_MOST_TIMES, _MOST_NATS = 1.2, 0.01  # NLL of a sound map, of that of exact Bayes
_AS_FAST = 0.005  # share of a time that does not matter
_CAUTIONS = {
    "smoke": (
        "Preset smoke only checks that everything runs: its policies are not meant to be good."
    )
}


def bounds(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The 95% interval of the mean of `[K, ...]` values by Student's t; NaN if K is 1."""
    average = values.mean(axis=0)
    if len(values) == 1:
        return np.full_like(average, np.nan), np.full_like(average, np.nan)
    error = values.std(axis=0, ddof=1) / np.sqrt(len(values))
    # `scipy.stats`, which calls the same function, takes a third of a second to import.
    error = error * scipy.special.stdtrit(len(values) - 1, (1 + _CONFIDENCE) / 2)
    return average - error, average + error


def interval(values: np.ndarray) -> Interval:
    """The mean of `[K]` values and its 95% interval, see `bounds`."""
    low, high = (None if np.isnan(end) else float(end) for end in bounds(values))
    return {"mean": float(values.mean()), "low": low, "high": high}


def at_most(number: int) -> float:
    """The share that an event has at most, with 95% confidence, if none of some trials showed it.

    Args:
      number: of trials, taken as independent.
    """
    return 1 - (1 - _CONFIDENCE) ** (1 / number) if number > 0 else 1.0


def differences(found: Measured, reference: Measured) -> Differences:
    """Mean differences of one case from another, arena by arena, with their 95% intervals.

    Args:
      found: metrics of the case.
      reference: metrics of the other case, in the same arenas.
    """

    def of(name: str) -> Interval:
        return interval(np.asarray(found[name] - reference[name], float))

    own, other = (case["is_right"].mean(axis=-1) for case in (found, reference))
    return {
        "accuracy": interval(own - other),
        "observations_per_poi": of("observations_per_poi"),
        "time_s": of("time_s"),
    }


def of_naive(played: dict[str, Case], name: str) -> OfNaive | None:
    """Compares looks and time of a policy with naive exploration of the same accuracy.

    Interpolates linearly between naive exploration with one, two and three looks of each robot at
    each PoI, and ignores looks that make it no more accurate. Compares a policy that is more
    accurate than all of these with the most accurate one: naive exploration would need even more.

    Args:
      played: cases in the same arenas.
      name: of the policy.

    Returns:
      The ratios; None if naive exploration was not played, or is more accurate with fewer looks.
    """
    if not {name, *_NAIVE} <= set(played):
        return None
    naive = [played[_NAIVE[0]]]
    for each in _NAIVE[1:]:
        if played[each]["accuracy"] > naive[-1]["accuracy"]:
            naive.append(played[each])
    case, accuracies = played[name], [each["accuracy"] for each in naive]
    if case["accuracy"] < accuracies[0]:
        return None

    def ratio(key: Literal["observations_per_poi", "time_s", "mean_time_s"]) -> float:
        return float(case[key] / np.interp(case["accuracy"], accuracies, [n[key] for n in naive]))

    return {
        "observations_per_poi": ratio("observations_per_poi"),
        "time_s": ratio("time_s"),
        "mean_time_s": ratio("mean_time_s"),
    }


def compared(missions: Missions) -> Missions:
    """Recomputes the ratios `of_naive` of missions in the same arenas."""
    found, played = missions.copy(), cases(missions)
    for name, case in played.items():
        ratios, kept = of_naive(played, name), case.copy()
        kept.pop("of_naive", None)
        found[name] = kept if ratios is None else {**kept, "of_naive": ratios}
    return found


def unsound(block: Beliefs) -> str | None:
    """Returns a warning if the map knows much less than exact Bayes after the same looks.

    Args:
      block: `belief` of a summary.

    Returns:
      A sentence with what to change; None if the negative log-likelihood is at most 1.2 times that
      of exact Bayes plus 0.01 nats, after any number of looks.
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
    """Code, versions and machines in which origins differ, on whatever days.

    Args:
      origins: of some figures.

    Returns:
      By name, the value of each origin.
    """
    found = [
        {**each["versions"], **{name: x for name, x in each.items() if name in _MADE_BY}}
        for each in origins
    ]
    names = dict.fromkeys(name for each in found for name in each)
    values = {name: [str(each.get(name, "unknown")) for each in found] for name in names}
    return {name: each for name, each in values.items() if len(set(each)) > 1}


def several_origins(origins: Sequence[Origin]) -> str | None:
    """Says in what the origins of a run's stages differ; None if they do not."""
    parts = [
        f"{name} {' and '.join(dict.fromkeys(values))}"
        for name, values in differences_of(origins).items()
    ]
    return f"Stages of this run were made with different {', '.join(parts)}." if parts else None


def remarks(found: Summary) -> list[str]:
    """What to keep in mind about all results of a run.

    Args:
      found: its summary.

    Returns:
      Sentences. Where results are not meant to be good, none says how to improve them.
    """
    caution = _CAUTIONS.get(found["preset"]) or unsound(found["belief"])
    return [each for each in (several_origins(found.get("origins", ())), caution) if each]


def detection_sizes(block: Missions) -> str:
    """Says how many bytes a detection takes, on average over those of some missions.

    Args:
      block: `mission` of a summary or of an evaluation.
    """
    size = traffic(block)
    latent, features, raw = (
        f"{mean(number):,.0f}" for number in (size["latent"], size["features"], size["raw"])
    )
    return (
        f"A detection takes {latent} bytes in the map. In these missions it takes, on "
        f"average over the sensors that made it, {features} bytes as the detector's "
        f"features and {raw} as a raw scan."
    )


def verdict(played: dict[str, Case]) -> str | None:
    """Compares the latent policy with naive exploration, and its time with the fastest policy's.

    Args:
      played: cases in the same arenas.

    Returns:
      A sentence about median times and, if it differs, one about accuracy; None unless both
      policies were played.
    """
    if not {REFERENCE, "naive"} <= set(played):
        return None
    own = played[REFERENCE]

    def against(name: str) -> str:
        percent = 100 * (mean(own["time_s"]) / mean(played[name]["time_s"]) - 1)
        if abs(percent) < 100 * _AS_FAST:
            return "as fast as "
        return f"{abs(percent):.0f} % {'faster' if percent < 0 else 'slower'} than "

    text = f"By median times, the latent policy is {against('naive')}naive exploration"
    faster = {
        name: mean(case["time_s"])
        for name, case in played.items()
        if not is_fault(name)
        and not name.startswith("naive")
        and mean(case["time_s"]) < (1 - _AS_FAST) * mean(own["time_s"])
        and mean(case["accuracy"]) > mean(own["accuracy"]) - AS_ACCURATE
    }
    if faster:
        best = min(faster, key=lambda name: faster[name])
        text += f" (and {against(best)}{best})"
    right, usual = mean(own["accuracy"]), mean(played["naive"]["accuracy"])
    if abs(right - usual) >= AS_ACCURATE:
        text += (
            f". It labels {_percent(right)} of the PoIs right, naive exploration {_percent(usual)}"
        )
    return f"{text}."


def _percent(share: float) -> str:
    return f"{100 * share:.1f}\u00a0%"
