"""`python -m benchmarks.imperfect_plot FILES --plot PICTURE`: curves of imperfect robots.

FILES are what `python -m benchmarks.imperfect RUN --json` has written: a curve for each run,
without a search and with one.
"""

import dataclasses
import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks import studies
from benchmarks.measure import save
from jaxsense.config.checks import check_fields, limited, require
from jaxsense.config.options import Name
from jaxsense.run import cli
from jaxsense.show.colours import series

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
    """Draws accuracy, NLL and time over errors of pose, losses and delays."""

    files: Annotated[tuple[Path, ...], Name("FILES")] = ()
    """Files with the figures."""
    figures: tuple[Literal["accuracy", "own", "nll", "looks", "time"], ...] = limited(
        ("accuracy", "nll", "time"), min_items=1
    )
    """What to draw, a row for each."""
    sweeps: tuple[str, ...] | None = None
    """What gets worse, a column for each; by default all that every curve has. Curves that lack one
    of those named are left out."""
    plot: Path = Path("imperfect.svg")
    """Picture to write; must be new."""

    def __post_init__(self):
        check_fields(self)
        is_once = 0 < len(self.files) == len(set(self.files))
        require(is_once, self, "files", "must name one file or more, each once")
        require(not self.plot.exists(), self, "plot", "must be a new file")


def curves_of(results: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """The curves of a file by name, as `draw` takes them.

    Args:
      results: the content of the file.
    """
    name = studies.name_of(results["options"]["run"])
    return {
        f"{name}, {curve}": {"usual": results["usual"], "sweeps": sweeps}
        for curve, sweeps in results["curves"].items()
    }


def draw(
    found: dict[str, dict], figures: Sequence[str], sweeps: Sequence[str] | None = None
) -> Figure:
    """A column for each thing that gets worse, and a row for each figure.

    Bands are 95% intervals of the differences from robots without errors, which are dotted.

    Args:
      found: figures of each curve, from `curves_of`.
      figures: names of what is drawn.
      sweeps: names of what gets worse, see `Arguments`.

    Raises:
      ValueError: if no curve has all sweeps, or no sweep is in all curves.
    """
    of_curves = {name: {s["sweep"]: s["rows"] for s in found[name]["sweeps"]} for name in found}
    known = [*dict.fromkeys(sweep for rows in of_curves.values() for sweep in rows)]
    if sweeps is None:
        sweeps = [name for name in known if all(name in rows for rows in of_curves.values())]
    found = {name: each for name, each in found.items() if {*sweeps} <= of_curves[name].keys()}
    if not (found and sweeps):
        raise ValueError(f"sweeps = {[*sweeps]}: must be some of {known} that a curve has")
    figure = Figure(figsize=(3 * len(sweeps), 2.4 * len(figures)), layout="constrained")
    axes = figure.subplots(len(figures), len(sweeps), sharex="col", sharey="row", squeeze=False)
    for i, (name, each) in enumerate(found.items()):
        style = {**series(i), "label": name}
        for column, sweep in zip(axes.T, sweeps, strict=True):
            for axis, figure_name in zip(column, figures, strict=True):
                _draw_curve(axis, of_curves[name][sweep], each["usual"], figure_name, style)
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
        found = {
            name: curve
            for file in arguments.files
            for name, curve in curves_of(json.loads(file.read_text(encoding="utf-8"))).items()
        }
        figure = draw(found, arguments.figures, arguments.sweeps)
    except (OSError, ValueError, KeyError, TypeError) as error:
        cli.fail(PROGRAM, f"files: {error}")
    save(PROGRAM, "plot", arguments.plot, figure)


if __name__ == "__main__":
    main()
