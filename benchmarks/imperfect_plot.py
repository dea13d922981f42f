"""`python -m benchmarks.imperfect_plot FILES --plot PICTURE`: curves of imperfect robots.

FILES are what `python -m benchmarks.imperfect RUN --json` has written: a curve for each, with the
name of the file.
"""

import dataclasses
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.measure import save
from jaxsense.config.checks import check_fields, limited, require
from jaxsense.config.options import Name
from jaxsense.run import cli
from jaxsense.show.colours import MARKERS

PROGRAM = "benchmarks.imperfect_plot"
_LABELS = {
    "accuracy": "accuracy",
    "own": "accuracy of own maps",
    "nll": "NLL",
    "looks": "looks per PoI",
    "time": "time over that without errors",
}


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Draw accuracy, NLL and time over errors of pose, losses and delays."""

    files: Annotated[tuple[Path, ...], Name("FILES")] = ()
    """Files with the figures."""
    figures: tuple[Literal["accuracy", "own", "nll", "looks", "time"], ...] = limited(
        ("accuracy", "nll", "time"), min_items=1
    )
    """What to draw, a row for each."""
    sweeps: tuple[str, ...] | None = None
    """What gets worse, a column for each; by default all that every file has."""
    plot: Path = Path("imperfect.png")
    """Picture to write; must be new."""

    def __post_init__(self):
        check_fields(self)
        names = [path.stem for path in self.files]
        is_once = 0 < len(names) == len(set(names))
        require(is_once, self, "files", "must name one file or more, each of another name")
        require(not self.plot.exists(), self, "plot", "must be a new file")


def draw(
    found: dict[str, dict], figures: Sequence[str], sweeps: Sequence[str] | None = None
) -> Figure:
    """A column for each thing that gets worse, and a row for each figure.

    Bands are 95% intervals of the differences from robots without errors, which are dotted.

    Args:
      found: by the name of the curve, what `benchmarks.imperfect` has written.
      figures: names of what is drawn.
      sweeps: names of what gets worse; by default all that every file has.

    Raises:
      ValueError: if a file lacks a sweep, or there is none.
    """
    of_files = [{s["sweep"]: s["rows"] for s in each["sweeps"]} for each in found.values()]
    common = [name for name in of_files[0] if all(name in each for each in of_files)]
    sweeps = common if sweeps is None else sweeps
    if not sweeps or not set(sweeps) <= set(common):
        raise ValueError(f"sweeps = {[*sweeps]}: must be among {common}, which every file has")
    figure = Figure(figsize=(3 * len(sweeps), 2.4 * len(figures)), layout="constrained")
    axes = figure.subplots(len(figures), len(sweeps), sharex="col", sharey="row", squeeze=False)
    for i, (name, each) in enumerate(found.items()):
        style = {"color": f"C{i}", "marker": MARKERS[i % len(MARKERS)], "label": name}
        for column, sweep in zip(axes.T, sweeps, strict=True):
            for axis, figure_name in zip(column, figures, strict=True):
                _draw_curve(axis, of_files[i][sweep], each["usual"], figure_name, style)
    for row, figure_name in zip(axes, figures, strict=True):
        row[0].set_ylabel(_LABELS[figure_name])
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
        figure = draw(found, arguments.figures, arguments.sweeps)
    except (OSError, ValueError, KeyError, TypeError) as error:
        cli.fail(PROGRAM, f"files: {error}")
    save(PROGRAM, "plot", arguments.plot, figure)


if __name__ == "__main__":
    main()
