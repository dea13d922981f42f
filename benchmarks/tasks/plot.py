"""The picture of the learning curves."""

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.tasks.record import Point
from jaxsense.show.colours import series
from jaxsense.show.drawing import name_ends
from jaxsense.tasks import estimate

PICTURE = Path(__file__).parents[2] / "docs" / "figures" / "tasks_curves.svg"

_ABREAST = 2  # plots
_LOWEST = 0.5  # share of the optimum, below which curves only begin


def draw(points: Iterable[Point]) -> Figure:
    """Return over that of the optimum or the best rule, by environment steps: a plot for each task.

    Lines are interquartile means over seeds, bands their 95 % intervals. Their names stand at their
    ends, of those that end below the plot with their last value.

    Args:
      points: of all curves.
    """
    of_task = _grouped(points, lambda point: (point.task, point.agent))
    learners = {name: i for i, name in enumerate(dict.fromkeys(p.learner for p in points))}
    rows = -(-len(of_task) // _ABREAST)
    figure = Figure(figsize=(4.6 * min(len(of_task), _ABREAST), 2.9 * rows), layout="constrained")
    axes = figure.subplots(rows, min(len(of_task), _ABREAST), sharey=True, squeeze=False)
    for axis in axes.flat[len(of_task) :]:
        axis.set_axis_off()
    named = []
    for axis, ((task, agent), found) in zip(axes.flat, of_task.items(), strict=False):
        ends = []
        for name, curve in _grouped(found, lambda point: point.learner).items():
            last = _draw_curve(axis, name, learners[name], curve)
            text = name if last >= _LOWEST else f"{name}: {last:.2f}"
            ends.append((text, last, series(learners[name])["color"]))
        axis.axhline(1.0, color="0.5", linestyle=":")
        axis.set(title=f"{task}, {agent}", ylim=(_LOWEST, 1.05))
        axis.xaxis.set_major_formatter(lambda steps, _: f"{steps / 1000:g}")
        axis.grid(alpha=0.3)
        named.append((axis, ends))
    for axis in axes[-1]:
        axis.set_xlabel("environment steps / 1000")
    for axis in axes[:, 0]:
        axis.set_ylabel("share of the best known")
    for axis, ends in named:
        name_ends(axis, ends)
    return figure


def _draw_curve(axis: Axes, name: str, number: int, points: Sequence[Point]) -> float:
    """Draws the curve of a learner in one task, and gives its last value."""
    of_steps = _grouped(points, lambda point: point.steps)
    found = [estimate(np.array([p.fraction for p in each])) for each in of_steps.values()]
    steps, style = list(of_steps), series(number)
    values = [each.value for each in found]
    axis.plot(steps, values, markersize=3, linewidth=1, label=name, **style)
    low, high = [each.low for each in found], [each.high for each in found]
    axis.fill_between(steps, low, high, color=style["color"], alpha=0.2, linewidth=0)
    return values[-1]


def _grouped(points, key):
    """Points by what they have in common, in order."""
    found = {}
    for point in points:
        found.setdefault(key(point), []).append(point)
    return found
