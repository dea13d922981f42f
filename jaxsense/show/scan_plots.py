"""Pictures of what detectors read: looks at each class, and recorded and simulated windows."""

import math
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxsense.config import Config
from jaxsense.show.colours import SOFT, as_hex, as_srgb, class_colour, series
from jaxsense.show.pairs import Pairs

_CLASSES, _COLUMNS = 4, 6  # side by side
_STRIP, _CURVE = 0.3, 1.5  # inches
_BINS = 61
_OUTSIDE = 0.002  # of all residuals, beyond the ends of the histogram
_SMALLEST = 0.02  # of the histogram's end, where the sizes begin


def scanlines(config: Config, windows: Mapping[str, np.ndarray]) -> Figure:
    """One look at each class as each detector reads it, from left to right.

    Dashed lines mark the bearing of the PoI, where robots expect its centre. All distances have one
    scale.

    Args:
      config: all settings.
      windows: for each modality `[C, window, channels]` readings, from left to right.
    """
    classes = config.arena.classes
    columns = min(len(classes), _CLASSES)
    lines = math.ceil(len(classes) / columns)
    sensors = [*windows] * lines
    heights = [_STRIP if windows[name].shape[-1] == 3 else _CURVE for name in sensors]
    size = (3.0 * columns, sum(heights) + 0.4 * lines + 0.6)
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots(len(heights), columns, squeeze=False, height_ratios=heights)
    for i, (name, row) in enumerate(zip(sensors, axes, strict=True)):
        line, is_first = i // len(windows), i % len(windows) == 0
        row[0].set_ylabel(name, rotation=0, ha="right", va="center")
        for c, ax in enumerate(row, line * columns):
            if c >= len(classes):
                ax.set_axis_off()
                continue
            if is_first:
                ax.set_title(classes[c], fontsize=10)
            _draw_look(ax, windows[name], c, as_hex(class_colour(config.arena, classes[c])))
            ax.tick_params(labelleft=c == line * columns)
    words = "rays of the window, from left to right; distances in metres; dashed: the PoI's bearing"
    figure.supxlabel(words, fontsize=10)
    return figure


def _draw_look(ax: Axes, readings: np.ndarray, c: int, colour: str) -> None:
    """Draws the look at class c of `[C, window, channels]` readings."""
    values = readings[c]
    if readings.shape[-1] == 3:  # an image
        ax.imshow(as_srgb(values)[None], aspect="auto", interpolation="none")
        ax.set_yticks([])
    else:
        top = 1.05 * np.max(readings, initial=0.0, where=np.isfinite(readings))
        ax.plot(values, ".", color=colour, markersize=3)
        ax.set_ylim(0, top or 1.0)
        ax.grid(axis="y", alpha=0.3)
    ax.set(xlim=(-0.5, len(values) - 0.5), xticks=[])
    ax.axvline((len(values) - 1) / 2, color=SOFT, linestyle="--", linewidth=1)


def windows(of_sensors: Sequence[Pairs]) -> Figure:
    """Recorded windows above simulated ones, of evenly chosen looks by each sensor.

    Args:
      of_sensors: the windows of each sensor.
    """
    heights = [0.8 if x.sensor.channels == 3 else 2.0 for x in of_sensors for _ in range(2)]
    figure = Figure(figsize=(2.4 * _COLUMNS, sum(heights) + 1.0), layout="constrained")
    axes = figure.subplots(len(heights), _COLUMNS, squeeze=False, height_ratios=heights)
    for pair, found in enumerate(of_sensors):
        number = min(_COLUMNS, len(found.recorded))
        chosen = np.linspace(0, len(found.recorded) - 1, number).astype(int)
        for kind, readings in enumerate((found.recorded, found.simulated)):
            row, shown = axes[2 * pair + kind], found.sensor.from_left(readings[chosen])
            row[0].set_ylabel(("recorded", "simulated")[kind])
            for ax, values, distance in zip(row, shown, found.distances[chosen], strict=False):
                if kind == 0:
                    ax.set_title(f"{found.sensor.name} at {distance:.2f} m", fontsize=9)
                if found.sensor.channels == 3:  # an image
                    ax.imshow(as_srgb(values)[None], aspect="auto", interpolation="nearest")
                    ax.set(yticks=[], xticks=[])
                else:
                    ax.plot(values, ".", color=series(kind)["color"], markersize=2)
                    ax.set_ylim(0, 1.05 * max(readings.max(), 1e-6))
            for ax in row[number:]:
                ax.set_axis_off()
    return figure


def residuals(of_sensors: Sequence[Pairs]) -> Figure:
    """Residuals of recorded and of simulated windows, over the rays that hit a PoI.

    To the left, how often each residual is. To the right, the share of residuals of at least a
    size, whatever their sign.

    Args:
      of_sensors: the windows of each sensor.
    """
    figure = Figure(figsize=(9.6, 3.4 * len(of_sensors)), layout="constrained")
    axes = figure.subplots(len(of_sensors), 2, squeeze=False)
    for (histogram, sizes), found in zip(axes, of_sensors, strict=True):
        _draw_residuals(histogram, sizes, found)
    return figure


def _draw_residuals(histogram: Axes, sizes: Axes, found: Pairs) -> None:
    kinds = {"recorded": found.residuals, "simulated": found.usual}
    kinds = {name: x[np.isfinite(x)] for name, x in kinds.items()}
    every = np.concatenate([*kinds.values()])
    end = max(np.quantile(np.abs(every), 1 - _OUTSIDE), 1e-6)
    unit = " [m]" if found.sensor.measures_distance else ""
    for i, (name, each) in enumerate(kinds.items()):
        median = round(float(np.median(each)), 4) + 0.0  # no -0
        label = f"{name}, median {median:+.4f}"
        bins = np.linspace(-end, end, _BINS)
        weights = np.full(len(each), 1 / len(each))
        colour = series(i)["color"]
        histogram.hist(
            each, bins.tolist(), weights=weights, histtype="step", color=colour, label=label
        )
        size = np.sort(np.abs(each))
        sizes.plot(size, 1 - np.arange(len(size)) / len(size), color=colour)
    reading = f"residual of {found.sensor.name}{unit}"
    histogram.set(xlabel=reading, ylabel="share of rays", yscale="log")
    sizes.set(xlabel=f"size of the {reading}", ylabel="share of rays of at least this size")
    sizes.set(xscale="log", yscale="log", xlim=(_SMALLEST * end, None))
    above = {"loc": "lower left", "bbox_to_anchor": (0, 1), "borderaxespad": 0.2}
    histogram.legend(fontsize=8, ncols=2, frameon=False, **above)
    for axis in (histogram, sizes):
        axis.grid(alpha=0.3)
