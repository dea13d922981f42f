"""The plots of missions: policies compared in the same arenas, and in other arenas and teams."""

import math
from collections.abc import Callable, Iterable
from typing import NamedTuple, cast

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxsense.show import drawing
from jaxsense.show.colours import SOFT, policy_colour, policy_marker
from jaxsense.summary.blocks import MISSIONS, Case, Evaluation, Missions, cases
from jaxsense.summary.blocks import policies as policies_of
from jaxsense.summary.compare import at_most
from jaxsense.summary.metrics import Number, mean

_REFERENCES = ("auction", "naive")  # of the times of teams, the first that played everywhere


class _Count(NamedTuple):
    """What the axis of a panel counts, and its name."""

    label: str
    of: Callable[[Evaluation], int]


_POIS = _Count("PoIs", lambda place: place["num_pois"])
_ROBOTS = _Count("robots", lambda place: len(place["robots"]))


def policies(block: Missions, num_pois: int) -> Figure:
    """Looks and time of every policy, the slowest last, with 95% intervals, and its wrong PoIs.

    The intervals are of the paired differences from the latent policy; with several seeds, of the
    means.

    Args:
      block: `mission` of the summary.
      num_pois: points of interest of a mission.
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
            style, colour = policy_marker(name), policy_colour(name)
            ax.errorbar(mean(case[key]), y, xerr=error, fmt=style, color=colour, capsize=3)
        ax.set(xlabel=MISSIONS[key].label, ylim=(-0.7, len(names) - 0.3))
        ax.set_xlim(0, 1.05 * ax.dataLim.x1)
        ax.grid(axis="x", alpha=0.3)
    axes[0].set_yticks(range(len(names)), names)
    for label, name in zip(axes[0].get_yticklabels(), names, strict=True):
        if name == "latent":
            label.set(color=policy_colour(name), weight="bold")
    place = axes[1].get_yaxis_transform()
    for y, name in enumerate(names):
        wrong = _wrong(played[name], num_pois)
        axes[1].text(1.02, y, wrong, transform=place, va="center", color=SOFT)
    return figure


def _wrong(case: Case, num_pois: int) -> str:
    """How many PoIs of all missions were wrong, or which share with several seeds."""
    match case["accuracy"]:
        case {"mean": float(accuracy), "low": low, "high": high}:
            text = f"{100 * (1 - accuracy):.1f} % of PoIs wrong"
            if low is None or high is None:
                return text
            return f"{text} ({100 * (1 - min(high, 1.0)):.1f} to {100 * (1 - low):.1f})"
    accuracy, number = mean(case["accuracy"]), round(mean(case["episodes"]) * num_pois)
    wrong = round((1 - accuracy) * number)
    share = f"{100 * wrong / number:.1f} %" if wrong else f"at most {100 * at_most(number):.2g} %"
    return f"{wrong:,} of {number:,} PoIs wrong ({share})"


def _error(value: Number, difference: Number | None) -> list[list[float]] | None:
    """Ends of a bar, from the interval of a value or else of its difference."""
    found = value if isinstance(value, dict) else difference
    match found:
        case {"mean": float(middle), "low": float(low), "high": float(high)}:
            return [[max(0.0, middle - low)], [max(0.0, high - middle)]]
    return None


def teams(places: Iterable[Evaluation]) -> Figure:
    """Median time of missions of every policy against numbers of PoIs and of robots.

    Times are relative to those of a policy that played everywhere, which stand below the numbers.

    Args:
      places: missions in two or more arenas or with two or more teams; of the same arena and team,
        those with the most missions are shown.
    """
    ordered = sorted(places, key=_num_missions)
    shown = [*{(p["num_pois"], p["side"], *p["robots"]): p for p in ordered}.values()]
    shown.sort(key=lambda place: (_POIS.of(place), _ROBOTS.of(place)))
    everywhere = set.intersection(*(set(policies_of(place["mission"])) for place in shown))
    reference = next((name for name in _REFERENCES if name in everywhere), None)
    of_arenas = [
        (f"{group[0]['num_pois']} PoIs in {group[0]['side']:g} m", _ROBOTS, group)
        for group in _groups(shown, "num_pois", "side")
        if len({_ROBOTS.of(place) for place in group}) > 1
    ]
    drawn = [place for _, _, group in of_arenas for place in group]
    panels = [
        (f"robots: {counted(group[0]['robots'])}", _POIS, group)
        for group in _groups(shown, "robots")
        if len(group) > 1 or group[0] not in drawn
    ]
    panels += of_arenas
    columns = min(len(panels), 3)
    rows = math.ceil(len(panels) / columns)
    figure = Figure(figsize=(5 * columns, 4 * rows), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for ax, (title, count, group) in zip(axes, panels, strict=False):
        ax.set(title=title)
        _draw_times(ax, group, count, reference)
    for ax in axes[len(panels) :]:
        ax.set_axis_off()
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


def _draw_times(ax: Axes, places: list[Evaluation], count: _Count, reference: str | None) -> None:
    """Draws a line for each policy: the time against the number of PoIs or of robots."""
    label, number = count

    def time(place: Evaluation, name: str) -> float:
        return mean(cases(place["mission"])[name]["time_s"])

    # Places of one number differ in something else, and no line leads from one to the other.
    numbers = [number(place) for place in places]
    line = "-" if len(set(numbers)) == len(numbers) else ""
    found = dict.fromkeys(name for place in places for name in policies_of(place["mission"]))
    ends = []
    for name in found:
        played = [place for place in places if name in policies_of(place["mission"])]
        times = [time(p, name) / (time(p, reference) if reference else 1.0) for p in played]
        colour, is_own = policy_colour(name), name == "latent"
        style = {"color": colour, "linewidth": 2.5 if is_own else 1.2, "zorder": 3 if is_own else 2}
        ax.plot([*map(number, played)], times, policy_marker(name) + line, label=name, **style)
        ends.append((name, times[-1], colour))
    ticks = sorted(set(numbers))
    texts = [str(n) for n in ticks]
    if reference:
        label += f"; below, the median time of {reference}"
        ax.set(ylabel=f"median time, of that of {reference}")
        for i, n in enumerate(ticks):
            of_number = sorted(f"{time(p, reference):.0f} s" for p in places if number(p) == n)
            texts[i] += "\n" + ", ".join(dict.fromkeys(of_number))
    else:
        ax.set(ylabel="median time [s]", ylim=(0, None))
    ax.set(xlabel=label)
    ax.set_xticks(ticks, texts)
    ax.grid(alpha=0.3)
    drawing.name_ends(ax, ends)
