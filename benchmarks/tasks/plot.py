"""The picture of the learning curves."""

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.tasks.record import Point
from jaxsense.show.colours import MARKERS
from jaxsense.tasks import estimate

PICTURE = Path(__file__).parents[2] / "docs" / "figures" / "tasks_curves.svg"

_LOWEST = 0.5  # share of the optimum, below which curves only begin


def draw(points: Iterable[Point]) -> Figure:
    """Return over that of the optimum or the best rule, by environment steps: a plot for each task.

    Lines are interquartile means over seeds, bands their 95 % intervals. What ends below the plot
    is written at its lower edge.

    Args:
      points: of all curves.
    """
    of_task = _grouped(points, lambda point: (point.task, point.agent))
    learners = {name: i for i, name in enumerate(dict.fromkeys(p.learner for p in points))}
    figure = Figure(figsize=(2.6 * len(of_task), 2.6), layout="constrained")
    axes = figure.subplots(1, len(of_task), sharey=True, squeeze=False)[0]
    for axis, ((task, agent), found) in zip(axes, of_task.items(), strict=True):
        below = []
        for name, curve in _grouped(found, lambda point: point.learner).items():
            last = _draw_curve(axis, name, learners[name], curve)
            if last < _LOWEST:
                below.append((f"{name}: {last:.2f}", f"C{learners[name]}"))
        for i, (text, colour) in enumerate(below):
            place = {"xytext": (4, 4 + 11 * i), "textcoords": "offset points"}
            axis.annotate(text, (0, 0), xycoords="axes fraction", color=colour, fontsize=8, **place)
        axis.axhline(1.0, color="0.5", linestyle=":")
        axis.set(title=f"{task}, {agent}", xlabel="environment steps", ylim=(_LOWEST, 1.05))
        axis.ticklabel_format(axis="x", style="sci", scilimits=(0, 3))
        axis.grid(alpha=0.3)
    axes[0].set_ylabel("return over the best known")
    handles = axes[0].get_legend_handles_labels()
    figure.legend(*handles, loc="outside upper center", ncols=len(learners), frameon=False)
    return figure


def _draw_curve(axis: Axes, name: str, number: int, points: Sequence[Point]) -> float:
    """Draws the curve of a learner in one task, and gives its last value."""
    of_steps = _grouped(points, lambda point: point.steps)
    found = [estimate(np.array([p.fraction for p in each])) for each in of_steps.values()]
    steps, colour = list(of_steps), f"C{number}"
    values = [each.value for each in found]
    marker = MARKERS[number % len(MARKERS)]
    axis.plot(steps, values, color=colour, marker=marker, markersize=3, linewidth=1, label=name)
    low, high = [each.low for each in found], [each.high for each in found]
    axis.fill_between(steps, low, high, color=colour, alpha=0.2, linewidth=0)
    return values[-1]


def _grouped(points, key):
    """Points by what they have in common, in order."""
    found = {}
    for point in points:
        found.setdefault(key(point), []).append(point)
    return found
