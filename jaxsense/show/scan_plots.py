"""Pictures of what detectors read: looks at each class."""

import math
from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxsense.config import Config
from jaxsense.show.colours import SOFT, as_hex, as_srgb, class_colour

_CLASSES = 4  # side by side
_STRIP, _CURVE = 0.3, 1.5  # inches


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
