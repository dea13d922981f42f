"""Pictures of recorded windows above the simulated ones that are nearest."""

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from jaxsense.show import plots
from jaxsense.show.colours import as_srgb
from jaxsense.show.pairs import Pairs

_COLUMNS = 6


def png(of_sensors: Sequence[Pairs]) -> bytes:
    """Draws evenly chosen looks of each sensor, as a PNG file.

    Args:
      of_sensors: the windows of each sensor.
    """
    heights = [0.8 if x.sensor.channels == 3 else 2.0 for x in of_sensors for _ in range(2)]
    figure = Figure(figsize=(2.4 * _COLUMNS, sum(heights) + 1.0), layout="constrained")
    axes = figure.subplots(len(heights), _COLUMNS, squeeze=False, height_ratios=heights)
    for pair, found in enumerate(of_sensors):
        number = min(_COLUMNS, len(found.recorded))
        chosen = np.linspace(0, len(found.recorded) - 1, number).astype(int)
        for kind, windows in enumerate((found.recorded, found.simulated)):
            row, readings = axes[2 * pair + kind], found.sensor.from_left(windows[chosen])
            row[0].set_ylabel(("recorded", "simulated")[kind])
            for ax, values, distance in zip(row, readings, found.distances[chosen], strict=False):
                if kind == 0:
                    ax.set_title(f"{found.sensor.name} at {distance:.2f} m", fontsize=9)
                if found.sensor.channels == 3:  # an image
                    ax.imshow(as_srgb(values)[None], aspect="auto", interpolation="nearest")
                    ax.set(yticks=[], xticks=[])
                else:
                    ax.plot(values, ".", color=f"C{kind}", markersize=2)
                    ax.set_ylim(0, 1.05 * max(windows.max(), 1e-6))
            for ax in row[number:]:
                ax.set_axis_off()
    return plots.png(figure)
