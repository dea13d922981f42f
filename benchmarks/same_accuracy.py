"""What policies need for the same accuracy, from points on their curves: figures, table, picture.

Between two points of a curve, looks and time are interpolated linearly; intervals are a bootstrap
over the arenas, the same for all policies.
"""

import itertools
from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from benchmarks import studies
from jaxsense.show.colours import policy_colour, policy_marker

ACCURACIES = (0.95, 0.98, 0.99)
_DRAWS = 1000  # of the bootstrap

Points = dict[str, np.ndarray]
"""`accuracy`, `confidence`, `looks`, `time` of K points of a curve in E arenas, `[K, E]` each."""


def stacked(points: list[dict[str, np.ndarray]]) -> Points:
    """A curve from its points.

    Args:
      points: figures of `Curves.play`, of K points.
    """
    return {key: np.stack([point[key] for point in points]) for key in points[0]}


Need = dict[str, float | None]
"""`mean` with `low` and `high`, of which the last is None if the policy may never get there."""


def at_accuracy(points: Points, accuracy: float, key: str) -> Need | None:
    """What a policy needs for an accuracy, with a 95% interval; None if it never gets there.

    Args:
      points: of its curve.
      accuracy: to reach, on average over the arenas.
      key: `looks` or `time`.
    """
    middle = _needed(points["accuracy"].mean(axis=1), points[key].mean(axis=1), accuracy)
    if not np.isfinite(middle):
        return None
    arenas = points["accuracy"].shape[1]
    draws = np.random.default_rng(0).integers(arenas, size=(_DRAWS, arenas))
    again = [
        _needed(
            points["accuracy"][:, rows].mean(axis=1), points[key][:, rows].mean(axis=1), accuracy
        )
        for rows in draws
    ]
    ends = np.quantile(again, (0.025, 0.975), method="inverted_cdf")
    low, high = (float(end) if np.isfinite(end) else None for end in ends)
    return {"mean": float(middle), "low": low, "high": high}


def _needed(accuracies: np.ndarray, needs: np.ndarray, accuracy: float) -> float:
    """Least need for an accuracy along a line through points; infinite if none is as accurate."""
    best = np.inf
    for i, j in itertools.combinations_with_replacement(range(len(needs)), 2):
        low, high = sorted((i, j), key=lambda k: accuracies[k])
        if accuracies[high] < accuracy:
            continue
        if accuracies[low] >= accuracy:
            best = min(best, needs[low])
            continue
        share = (accuracy - accuracies[low]) / (accuracies[high] - accuracies[low])
        best = min(best, needs[low] + share * (needs[high] - needs[low]))
    return float(best)


def as_block(name: str, varies: dict[str, tuple], points: Points) -> dict:
    """A curve for JSON.

    Args:
      name: of the policy.
      varies: what varies along the curve.
      points: of the curve.
    """
    means = {
        key: [round(float(x), 4) for x in values.mean(axis=1)] for key, values in points.items()
    }
    needs = {
        str(accuracy): {key: at_accuracy(points, accuracy, key) for key in ("looks", "time")}
        for accuracy in ACCURACIES
    }
    return {
        "policy": name,
        **{key: list(values) for key, values in varies.items()},
        **means,
        "at": needs,
    }


def as_table(blocks: list[dict]) -> str:
    """What every policy needs for each accuracy, as a Markdown table.

    Args:
      blocks: of `as_block`.
    """

    def text(need: Need | None, digits: int) -> str:
        if need is None:
            return "-"
        mean, low, high = (
            "?" if need[key] is None else f"{need[key]:.{digits}f}"
            for key in ("mean", "low", "high")
        )
        return f"{mean} ({low} to {high})"

    heads = [f"{key} at {a:g}" for key in ("looks", "time [s]") for a in ACCURACIES]
    rows = [f"| policy | {' | '.join(heads)} |", "| --- |" + " --- |" * len(heads)]
    for block in blocks:
        cells = [
            text(block["at"][str(a)][key], digits)
            for key, digits in (("looks", 2), ("time", 1))
            for a in ACCURACIES
        ]
        rows.append(f"| `{block['policy']}` | {' | '.join(cells)} |")
    return "\n".join(rows)


def table(results: Mapping[str, Any]) -> str:
    """What every policy needs for each accuracy, in Markdown, and how that came.

    Args:
      results: the content of the JSON file.
    """
    return studies.with_origin(as_table(results["policies"]), results)


def draw(blocks: list[dict]) -> Figure:
    """Looks and time of every policy against its share of wrong PoIs.

    Args:
      blocks: of `as_block`.
    """
    figure = Figure(figsize=(11, 4.5), layout="constrained")
    axes = figure.subplots(1, 2, sharey=True)
    for axis, key, label in zip(
        axes, ("looks", "time"), ("looks per PoI", "mean time of a mission [s]"), strict=True
    ):
        for block in blocks:
            name = block["policy"]
            if name == "random":
                continue
            order = np.argsort(block[key])
            wrong = 100 * (1 - np.array(block["accuracy"]))[order]
            axis.plot(
                np.array(block[key])[order],
                wrong,
                color="k" if name == "oracle" else policy_colour(name),
                marker=policy_marker(name),
                linewidth=2.5 if name == "latent" else 1.2,
                linestyle=":" if name == "oracle" else "-",
                label=name,
            )
        axis.set(xlabel=label, yscale="log", xlim=(0, None))
        axis.yaxis.set(major_formatter="{x:g}", minor_formatter="{x:g}")
        axis.grid(alpha=0.3, which="both")
    axes[0].set_ylabel("wrong PoIs [%]")
    handles = axes[0].get_legend_handles_labels()
    figure.legend(*handles, loc="outside upper center", ncols=len(handles[1]), frameon=False)
    return figure
