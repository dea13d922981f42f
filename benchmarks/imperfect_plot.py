"""`python -m benchmarks.imperfect_plot FILES --plot PICTURE`: curves of imperfect robots.

FILES are what `python -m benchmarks.imperfect RUN --json` has written, a curve for each, which has
the name of its file.
"""

import dataclasses
import json
import sys
from pathlib import Path
from typing import Annotated

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxsense.config.checks import check_fields, require
from jaxsense.config.options import Name
from jaxsense.run import cli
from jaxsense.show.colours import MARKERS

PROGRAM = "benchmarks.imperfect_plot"
_FIGURES = {"accuracy": "accuracy", "nll": "NLL", "time": "time over that without errors"}


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Draw accuracy, NLL and time over errors of pose, losses and delays."""

    files: Annotated[tuple[Path, ...], Name("FILES")] = ()
    """Files with the figures."""
    plot: Path = Path("imperfect.png")
    """Picture to write; must be new."""

    def __post_init__(self):
        check_fields(self)
        require(bool(self.files), self, "files", "must name one file or more")
        require(not self.plot.exists(), self, "plot", "must be a new file")


def draw(found: dict[str, dict]) -> Figure:
    """A column for each thing that gets worse in all files, and a row for each figure.

    Bands are 95% intervals of the differences from robots without errors, which are dotted.

    Args:
      found: by the name of the curve, what `benchmarks.imperfect` has written.
    """
    of_files = [{s["sweep"]: s["rows"] for s in each["sweeps"]} for each in found.values()]
    sweeps = [name for name in of_files[0] if all(name in each for each in of_files)]
    size = 3 * len(sweeps), 2.4 * len(_FIGURES)
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots(len(_FIGURES), len(sweeps), sharex="col", sharey="row", squeeze=False)
    for i, (name, each) in enumerate(found.items()):
        style = {"color": f"C{i}", "marker": MARKERS[i % len(MARKERS)], "label": name}
        for column, sweep in zip(axes.T, sweeps, strict=True):
            for axis, figure_name in zip(column, _FIGURES, strict=True):
                _draw_curve(axis, of_files[i][sweep], each["usual"], figure_name, style)
    for row, label in zip(axes, _FIGURES.values(), strict=True):
        row[0].set_ylabel(label)
        for axis in row:
            axis.grid(alpha=0.3)
    for axis, sweep in zip(axes[-1], sweeps, strict=True):
        axis.set_xlabel(sweep)
    handles = axes[0, 0].get_legend_handles_labels()
    figure.legend(*handles, loc="outside upper center", ncols=len(found), frameon=False)
    return figure


def _draw_curve(axis: Axes, rows: list[dict], usual: dict, name: str, style: dict) -> None:
    """Times are drawn over those without errors."""
    sizes = [row["size"] for row in rows]
    values, _, widths = np.array([row[name] for row in rows]).T
    unit = usual[name] if name == "time" else 1.0
    low, high = ((values + sign * widths) / unit for sign in (-1, 1))
    axis.plot(sizes, values / unit, markersize=4, **style)
    axis.fill_between(sizes, low, high, color=style["color"], alpha=0.2)
    axis.axhline(usual[name] / unit, color=style["color"], linestyle=":")


def main(argv: list[str] | None = None) -> None:
    """The program."""
    arguments = cli.parse(PROGRAM, Arguments, sys.argv[1:] if argv is None else argv)
    try:
        found = {p.stem: json.loads(p.read_text(encoding="utf-8")) for p in arguments.files}
        figure = draw(found)
    except (OSError, ValueError, KeyError, TypeError) as error:
        cli.fail(PROGRAM, f"files: {error}")
    figure.savefig(arguments.plot, dpi=110)


if __name__ == "__main__":
    main()
