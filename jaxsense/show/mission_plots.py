"""The plots of missions: policies compared in the same arenas, and in other arenas and teams."""

import math
from collections.abc import Iterable
from typing import cast

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxsense.show.colours import policy_colour, policy_marker
from jaxsense.summary.blocks import MISSIONS, Evaluation, Missions, cases
from jaxsense.summary.blocks import policies as policies_of
from jaxsense.summary.metrics import Number, mean


def policies(block: Missions) -> Figure:
    """Looks and time of every policy, the slowest last, with 95% intervals.

    The intervals are of the paired differences from the latent policy; with several seeds, of the
    means.

    Args:
      block: `mission` of the summary.
    """
    played = policies_of(block)
    names = sorted(played, key=lambda name: -mean(played[name]["mean_time_s"]))
    figure = Figure(figsize=(10, 1.2 + 0.35 * len(names)), layout="constrained")
    axes = figure.subplots(1, 2, sharey=True)
    keys = ("observations_per_poi", "observations_per_poi"), ("mean_time_s", "time_s")
    for ax, (key, difference) in zip(axes, keys, strict=True):
        for y, name in enumerate(names):
            case = cast(dict[str, Number], played[name])
            error = _error(case[key], cast(dict, case.get("intervals", {})).get(difference))
            ax.errorbar(
                mean(case[key]), y, xerr=error, fmt="o", color=policy_colour(name), capsize=3
            )
        ax.set(xlabel=MISSIONS[key].label, xlim=(0, None), ylim=(-0.7, len(names) - 0.3))
        ax.grid(axis="x", alpha=0.3)
    axes[0].set_yticks(range(len(names)), [name.replace("_", " ") for name in names])
    for label, name in zip(axes[0].get_yticklabels(), names, strict=True):
        label.set(color=policy_colour(name), weight="bold" if name == "latent" else "normal")
    for y, name in enumerate(names):
        wrong = f"{100 * (1 - mean(played[name]['accuracy'])):.1f} % of PoIs wrong"
        place = axes[1].get_yaxis_transform()
        axes[1].text(1.02, y, wrong, transform=place, va="center", color="0.4")
    return figure


def _error(value: Number, difference: Number | None) -> list[list[float]] | None:
    """Ends of a bar, from the interval of a value or else of its difference."""
    found = value if isinstance(value, dict) else difference
    match found:
        case {"mean": float(middle), "low": float(low), "high": float(high)}:
            return [[middle - low], [high - middle]]
    return None


def teams(places: Iterable[Evaluation]) -> Figure:
    """Median time of missions of every policy against numbers of PoIs and of robots.

    Args:
      places: missions in two or more arenas or with two or more teams; of the same arena and team,
        those with the most missions are shown.
    """
    ordered = sorted(places, key=_num_missions)
    shown = [*{(p["num_pois"], p["side"], *p["robots"]): p for p in ordered}.values()]
    shown.sort(key=lambda place: (place["num_pois"], len(place["robots"])))
    of_arenas = [
        (f"{group[0]['num_pois']} PoIs in {group[0]['side']:g} m", "robots", group)
        for group in _groups(shown, "num_pois", "side")
        if len({len(place["robots"]) for place in group}) > 1
    ]
    drawn = [place for _, _, group in of_arenas for place in group]
    panels = [
        (f"robots: {counted(group[0]['robots'])}", "num_pois", group)
        for group in _groups(shown, "robots")
        if len(group) > 1 or group[0] not in drawn
    ]
    panels += of_arenas
    columns = min(len(panels), 3)
    rows = math.ceil(len(panels) / columns)
    figure = Figure(figsize=(5 * columns, 4 * rows), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    handles = {}
    for ax, (title, key, group) in zip(axes, panels, strict=False):
        _draw_times(ax, group, key)
        ax.set(title=title)
        found, labels = ax.get_legend_handles_labels()
        handles |= dict(zip(labels, found, strict=True))
    for ax in axes[len(panels) :]:
        ax.set_axis_off()
    figure.legend(handles.values(), handles.keys(), loc="outside right upper")
    return figure


def _num_missions(place: Evaluation) -> int:
    return max(case["episodes"] for case in cases(place["mission"]).values())


def _groups(places: list[Evaluation], *keys: str) -> list[list[Evaluation]]:
    """Places grouped by the values of the keys."""
    found: dict[str, list[Evaluation]] = {}
    for place in places:
        found.setdefault(str([place[key] for key in keys]), []).append(place)
    return [*found.values()]


def counted(robots: list[str]) -> str:
    """A team in words: `2 camera, 1 lidar`."""
    return ", ".join(f"{robots.count(modality)} {modality}" for modality in dict.fromkeys(robots))


def _draw_times(ax: Axes, places: list[Evaluation], key: str) -> None:
    """Draws a line for each policy: the time against the number of PoIs or of robots."""

    def number(place: Evaluation) -> int:
        return place["num_pois"] if key == "num_pois" else len(place["robots"])

    # Places of one number differ in something else, and no line leads from one to the other.
    line = "-" if len(set(map(number, places))) == len(places) else ""
    found = dict.fromkeys(name for place in places for name in policies_of(place["mission"]))
    for name in found:
        played = [
            (number(place), mean(case["time_s"]))
            for place in places
            if (case := cases(place["mission"]).get(name))
        ]
        if played:
            style = policy_marker(name) + line
            numbers, times = zip(*played, strict=True)
            ax.plot(numbers, times, style, color=policy_colour(name), label=name)
    label = "PoIs" if key == "num_pois" else "robots"
    ax.set(xlabel=label, ylabel="median time [s]", ylim=(0, None))
    ax.set_xticks(sorted(set(map(number, places))))
    ax.grid(alpha=0.3)
