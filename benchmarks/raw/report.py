"""`python -m benchmarks.raw.report FILES`: tables and pictures of what fails.

FILES are what `python -m benchmarks.raw --json` has written, one or more tables in each.
"""

import dataclasses
import json
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from benchmarks.measure import save
from benchmarks.raw.variants import (
    ABLATION,
    DEPTHS,
    OF_DEPTH,
    OF_RATIO,
    OURS,
    PAPER,
    RATIOS,
    TABLES,
    Variant,
)
from benchmarks.studies import as_table, with_origin
from jaxsense import PRESETS
from jaxsense.config.checks import check_fields, require
from jaxsense.config.options import Name
from jaxsense.run import cli
from jaxsense.show.colours import class_colour, series
from jaxsense.summary.compare import bounds, interval

PROGRAM = "benchmarks.raw.report"
_LINES = "ours", "paper", "ours, sum of squares", "paper, standardised"
_KNOWN = 1 / 3, 2 / 3  # accuracies of chance, and of one who knows the colour or the shape alone
_ALL_LOOKS, _SINGLE_LOOKS, _DECODERS = range(3)  # networks whose gradients are measured

Figures = dict[str, Any]
"""Figures of a variant: by name a list over the seeds, and `posteriors` of the first."""

Found = dict[tuple[str, str], Figures]
"""Figures by the names of a table and a variant."""


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Prints tables of trained variants, and draws them."""

    files: Annotated[tuple[Path, ...], Name("FILES")] = ()
    """Files with the figures."""
    plot: Path | None = None
    """Picture to write of accuracies, units and gradients; must be new."""
    posteriors: Path | None = None
    """Picture to write of the posteriors of a failure and of a success; must be new."""

    def __post_init__(self):
        check_fields(self)
        require(bool(self.files), self, "files", "must name one file or more")
        for field in ("plot", "posteriors"):
            path = getattr(self, field)
            require(path is None or not path.exists(), self, field, "must be a new file")


def gather(*wholes: Mapping[str, Any]) -> tuple[Found, list[int]]:
    """Figures of all variants, and the seeds.

    Args:
      *wholes: contents of files from `python -m benchmarks.raw --json`.

    Raises:
      ValueError: if the files are of different seeds, steps or scans, or a table lacks variants.
    """
    for field in ("seeds", "steps", "scans"):
        if any(whole[field] != wholes[0][field] for whole in wholes):
            raise ValueError(f"{field} = {[w[field] for w in wholes]}: must be the same in all")
    rows = [row for whole in wholes for row in whole["variants"]]
    found = {(row["table"], row["name"]): row for row in rows}
    for table in dict.fromkeys(table for table, _ in found):
        lacking = [v.name for v in TABLES[table] if (table, v.name) not in found]
        if lacking:
            raise ValueError(f"table {table}: lacks {', '.join(lacking)}")
    return found, wholes[0]["seeds"]


def _spread(values: Sequence[float] | np.ndarray, digits: int) -> str:
    """The mean over the seeds with their range, unless all are alike."""
    mean, low, high = (f"{x:.{digits}f}" for x in (np.mean(values), np.min(values), np.max(values)))
    return mean if low == high else f"{mean} ({low} to {high})"


def _share(values: Sequence[float] | np.ndarray) -> str:
    """The mean over the seeds with the half-width of its 95% interval, and the range."""
    found = interval(np.asarray(values, float))
    low, high = found["low"], found["high"]
    width = "?" if low is None or high is None else f"{(high - low) / 2:.3f}"
    return f"{found['mean']:.3f} ± {width} ({np.min(values):.3f} to {np.max(values):.3f})"


def of_ablation(found: Found) -> str:
    """The table of the ablation.

    Args:
      found: figures of all variants.
    """
    heads = ["", "right, one look by each", "right, K looks by each", "units",
             "variance by class", "by distance and light"]  # fmt: skip

    def row(variant: Variant) -> list[str]:
        of = found["ablation", variant.name]
        shares = [_share(of["pair"]), _share(of["right"]) if variant.looks > 1 else ""]
        others = [_spread(of["units"], 1), _spread(of["by_class"], 2), _spread(of["by_view"], 2)]
        return [variant.name, *shares, *others]

    return as_table(heads, [row(variant) for variant in ABLATION])


def of_ratio(found: Found) -> str:
    """Share of right PoIs after one look by each sensor, over the ratio of the windows' sizes.

    Args:
      found: figures of all variants.
    """
    rows = [
        [f"{c}:{w}", *(_share(found["ratio", f"{name}, {c}:{w}"]["pair"]) for name in OF_RATIO)]
        for c, w in RATIOS
    ]
    return as_table(["camera : LiDAR", *OF_RATIO], rows)


def of_depth(found: Found) -> str:
    """Units, gradients and weights over the depth of the networks.

    Args:
      found: figures of all variants.
    """
    heads = ["", "depth", "right, one look by each", "units", "gradient, encoder: first steps",
             "all steps", "decoders: first steps", "all steps", "weights, layer that shrinks most",
             "dead units, worst layer: at the start", "at the end"]  # fmt: skip

    def row(name: str, depth: int) -> list[str]:
        of = found["depth", f"{name}, depth {depth}"]
        cells = [name, str(depth), _share(of["pair"]), _spread(of["units"], 1)]
        for network in (_ALL_LOOKS, _DECODERS):
            cells.append(_spread(np.array(of["gradient_at_start"])[:, network], 2))
            cells.append(_spread(_gradient(of, network), 2))
        others = ("least_weights", "dead_at_start", "dead")
        return [*cells, *(_spread(of[figure], 2) for figure in others)]

    return as_table(heads, [row(name, depth) for name in OF_DEPTH for depth in DEPTHS])


def _gradient(of: Figures, network: int) -> np.ndarray:
    """`[seeds]` median over the tenths of a training."""
    return np.median(np.array(of["gradient"])[:, :, network], axis=1)


def of_seeds(found: Found, seeds: list[int]) -> str:
    """Failures next to successes: what each seed comes to in the paper's way and in ours.

    Args:
      found: figures of all variants.
      seeds: of the trainings.
    """
    classes = PRESETS["raw"].arena.classes
    figures = ("right", f"of {', '.join(classes)}", "units", "variance by class")
    heads = [f"{variant.name}: {figure}" for variant in (PAPER, OURS) for figure in figures]

    def cells(of: Figures, i: int) -> list[str]:
        each = ", ".join(f"{x:.2f}" for x in of["of_classes"][i])
        return [f"{of['pair'][i]:.3f}", each, f"{of['units'][i]:.0f}", f"{of['by_class'][i]:.2f}"]

    both = [found["ablation", variant.name] for variant in (PAPER, OURS)]
    rows = [[str(s), *cells(both[0], i), *cells(both[1], i)] for i, s in enumerate(seeds)]
    return as_table(["seed", *heads], rows)


def written(content: Mapping[str, Any], make: Callable[[Found], str]) -> str:
    """The table of a file, and how it came.

    Args:
      content: of the file.
      make: the table.
    """
    found, _ = gather(content)
    return with_origin(make(found), content)


def draw(found: Found) -> Figure:
    """Accuracy of every variant, accuracy over the ratio, and units and gradients over the depth.

    Args:
      found: figures of all variants, of all tables.
    """
    figure = Figure(figsize=(15, 7), layout="constrained")
    axes = figure.subplot_mosaic(
        [["ablation", "ratio", "units"], ["ablation", "ratio", "gradient"]],
        width_ratios=(1.5, 1, 1),
    )
    _draw_ablation(axes["ablation"], found)
    places = np.log2([camera / lidar for camera, lidar in RATIOS])
    for name in OF_RATIO:
        each = [found["ratio", f"{name}, {c}:{w}"]["pair"] for c, w in RATIOS]
        _line(axes["ratio"], places, each, name)
    axes["ratio"].set_xticks(places, [f"{c}:{w}" for c, w in RATIOS])
    for accuracy in _KNOWN:
        axes["ratio"].axhline(accuracy, color="0.6", linestyle=":")
    axes["ratio"].set(
        xlabel="numbers of the camera's window : of the LiDAR's",
        ylabel="right after one look by each sensor",
        ylim=(0.25, 1.02),
    )
    for name in OF_DEPTH:
        each = [found["depth", f"{name}, depth {depth}"] for depth in DEPTHS]
        _line(axes["units"], np.log2(DEPTHS), [of["units"] for of in each], name)
        for network, style in ((_ALL_LOOKS, "-"), (_DECODERS, "--")):
            of_network = [_gradient(of, network) for of in each]
            _line(axes["gradient"], np.log2(DEPTHS), of_network, name, style)
    axes["units"].set(ylabel="active units, of 2", ylim=(-0.1, 2.1))
    axes["gradient"].set(
        xlabel="hidden layers of every network",
        ylabel="gradient of the first layer over the last's\n(solid: encoder, dashed: decoders)",
        yscale="log",
    )
    for name in ("units", "gradient"):
        axes[name].set_xticks(np.log2(DEPTHS), [str(depth) for depth in DEPTHS])
    for axis in axes.values():
        axis.grid(alpha=0.3)
    # The axes have some lines in common.
    handles = {
        name: line
        for axis in (axes["ratio"], axes["units"])
        for line, name in zip(*axis.get_legend_handles_labels(), strict=True)
    }
    figure.legend(
        handles.values(), handles, loc="outside upper right", ncols=len(handles), frameon=False
    )
    return figure


def _draw_ablation(axis: Axes, found: Found) -> None:
    """A row for each variant: a point for each seed, and the mean with its 95% interval."""
    for place, variant in enumerate(ABLATION):
        values = np.array(found["ablation", variant.name]["pair"])
        low, high = bounds(values)
        is_named = variant.name in (PAPER.name, OURS.name)
        colour = series(0 if variant.name.startswith(OURS.name) else 1)["color"]
        axis.plot(values, np.full(len(values), place), ".", color=colour, alpha=0.3)
        axis.plot([low, high], [place, place], color=colour, linewidth=2.5)
        axis.plot(values.mean(), place, "o", color=colour, markersize=9 if is_named else 6)
    for accuracy in _KNOWN:
        axis.axvline(accuracy, color="0.6", linestyle=":")
    axis.set_yticks(range(len(ABLATION)), [variant.name for variant in ABLATION])
    axis.invert_yaxis()
    axis.set(xlabel="right after one look by each sensor", xlim=(0.25, 1.02))


def _line(axis: Axes, places: np.ndarray, each: list, name: str, style: str = "-") -> None:
    """Means over the seeds with their range, at `[K]` places."""
    values = np.array(each, float)
    of_line = series(_LINES.index(name))
    axis.plot(places, values.mean(axis=1), style, label=name, **of_line)
    low, high = values.min(axis=1), values.max(axis=1)
    axis.fill_between(places, low, high, color=of_line["color"], alpha=0.15)


def draw_posteriors(found: Found) -> Figure:
    """Fig. 4 of a failure above that of a success: posteriors of the first seed, by class.

    Args:
      found: figures of all variants.
    """
    arena, names = PRESETS["raw"].arena, {"joint": "camera & LiDAR", "camera": "camera alone",
                                          "lidar": "LiDAR alone"}  # fmt: skip
    figure = Figure(figsize=(11, 7.4), layout="constrained")
    axes = figure.subplots(2, len(names), sharex="row", sharey="row")
    for row, variant in zip(axes, (PAPER, OURS), strict=True):
        posteriors = found["ablation", variant.name]["posteriors"]
        for axis, (name, title) in zip(row, names.items(), strict=True):
            for label, of_class in zip(arena.classes, np.array(posteriors[name]), strict=True):
                colour = class_colour(arena, label)
                for mean, std in of_class:
                    axis.add_patch(Ellipse(mean, *(2 * std), fill=False, color=colour, alpha=0.3))
                axis.plot(*of_class[:, 0].T, ".", color=colour, label=label)
            axis.set_title(f"{variant.name}: {title}")
            axis.set_xlabel("$\\mu_1$")
            axis.grid(alpha=0.3)
        row[0].set_ylabel("$\\mu_2$")
    figure.legend(
        *axes[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=3, frameon=False
    )
    return figure


def main(argv: list[str] | None = None) -> None:
    """The program."""
    arguments = cli.parse(PROGRAM, Arguments, sys.argv[1:] if argv is None else argv)
    try:
        found, seeds = gather(
            *(json.loads(path.read_text(encoding="utf-8")) for path in arguments.files)
        )
    except (OSError, ValueError, KeyError) as error:
        cli.fail(PROGRAM, f"files: {error}")
    tables = {table for table, _ in found}
    for option, needs in (("plot", {*TABLES}), ("posteriors", {"ablation"})):
        if getattr(arguments, option) is not None and not needs <= tables:
            cli.fail(PROGRAM, f"{option}: needs the tables {', '.join(sorted(needs - tables))}")
    if "ablation" in tables:
        print(of_ablation(found), of_seeds(found, seeds), sep="\n\n", end="\n\n")
    for name, text in (("ratio", of_ratio), ("depth", of_depth)):
        if name in tables:
            print(text(found), end="\n\n")
    if arguments.plot is not None:
        save(PROGRAM, "plot", arguments.plot, draw(found))
    if arguments.posteriors is not None:
        save(PROGRAM, "posteriors", arguments.posteriors, draw_posteriors(found))


if __name__ == "__main__":
    main()
