"""The plots of what was learned: the paper's Fig. 5, and calibration."""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

from jaxsense.config import Config
from jaxsense.core.types import Reliability
from jaxsense.show import drawing
from jaxsense.show.colours import MARKERS, SOFT, modality_colour, policy_colour
from jaxsense.summary.blocks import AGENTS, Agent, Beliefs
from jaxsense.summary.compare import bounds
from jaxsense.summary.metrics import mean

Arrays = dict[str, np.ndarray]
Curves = dict[str, Arrays]
"""For each Q-network, named by its modality or `team`, `[epochs]` or `[K, epochs]` mean total
rewards: `reward` of the exploring policy, and `evaluation` of the learned policy alone on the map,
NaN where it was not played."""

_Names = list[tuple[str, float, str]]  # text, height and colour of names next to an axis
_SMOOTHING = 20  # epochs
_MIN_LOOKS = 20  # in a bin of the calibration
_EXPLORING = "#8c8c8c"
_OPTIMAL_LINE, _NAIVE_LINE, _RANDOM_LINE = "--", ":", (0, (1, 4))


class _Kind(NamedTuple):
    """How rewards are drawn: their name, and from `[K, epochs]` the epochs and `[K, E]` heights."""

    label: str
    colour: str
    points: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]


def rewards(curves: Curves, agents: Mapping[str, Agent]) -> Figure:
    """The paper's Fig. 5: reward of whole episodes over the epochs, with other policies as lines.

    Robots alone on the map share an axis.

    Args:
      curves: of one run or of several seeds.
      agents: the block `dqn` of the summary.
    """
    panels: list[tuple[str, Arrays, Agent | None]] = []
    for name, of_network in curves.items():
        if name in agents:
            panels.append((f"{name}: a robot alone on the map", of_network, agents[name]))
            continue
        # Rewards of a team's episodes cannot be compared with those of a single robot on the map.
        alone, agent = next(iter(agents.items()))
        evaluation = {"evaluation": of_network["evaluation"]}
        panels.append((f"episodes of the whole {name}", {"reward": of_network["reward"]}, None))
        panels.append((f"{name}: one {alone} robot alone on the map", evaluation, agent))
    figure = Figure(figsize=(5 * len(panels), 4), layout="constrained")
    axes = figure.subplots(1, len(panels), squeeze=False)[0]
    names: list[_Names] = []
    for ax, (title, of_panel, agent) in zip(axes, panels, strict=True):
        drawn = (_draw_rewards(ax, _KINDS[kind], np.atleast_2d(x)) for kind, x in of_panel.items())
        names.append([name for of_kind in drawn for name in of_kind])
        if agent is not None:
            names[-1] += _draw_references(ax, agent)
        ax.set(title=title, xlabel="epoch", ylabel="total reward of an episode")
        ax.grid(alpha=0.3)
    alone = [ax for ax, (*_, agent) in zip(axes, panels, strict=True) if agent is not None]
    if alone:
        bottom = min(_bottom(agent) for *_, agent in panels if agent is not None)
        top = max(ax.get_ylim()[1] for ax in alone)
        for ax in alone:
            ax.set_ylim(bottom, top)
    for ax, of_panel in zip(axes, names, strict=True):
        bottom = ax.get_ylim()[0]
        drawing.name_ends(
            ax,
            [
                (f"{text}: {y:.2f}, below" if y < bottom else text, y, colour)
                for text, y, colour in of_panel
            ],
        )
    return figure


def _bottom(agent: Agent) -> float:
    """Where the axis of an agent begins; random policies are far below."""
    naive = mean(agent["naive"])
    optimal = naive if agent["optimal"] is None else mean(agent["optimal"])
    return min(naive, mean(agent["return"])) - max(0.5, optimal - naive)


def _draw_rewards(ax: Axes, kind: _Kind, values: np.ndarray) -> _Names:
    """Draws `[K, epochs]` rewards: the mean, and of several seeds its 95% interval."""
    if len(values) == 0:
        return []
    label, colour, points = kind
    epochs, shown = points(values)
    middle = shown.mean(axis=0)
    ax.plot(epochs, middle, color=colour, label=label, linewidth=1.2)
    if len(shown) > 1:
        low, high = bounds(shown)
        ax.fill_between(epochs, low, high, color=colour, alpha=0.2, linewidth=0)
    finite = middle[np.isfinite(middle)]
    return [(label, float(finite[-1]), colour)] if len(finite) else []


def _draw_references(ax: Axes, agent: Agent) -> _Names:
    """Draws the policies that an agent is compared with, as lines."""
    names: _Names = []
    lines = {"optimal": _OPTIMAL_LINE, "naive": _NAIVE_LINE, "random": _RANDOM_LINE}
    for name, line in lines.items():
        if agent[name] is not None:
            height, colour = mean(agent[name]), policy_colour(name)
            ax.axhline(height, color=colour, linestyle=line, label=AGENTS[name].label)
            names.append((AGENTS[name].label, height, colour))
    return names


def _smoothed(reward: np.ndarray) -> np.ndarray:
    """Running mean over the epochs in which an episode ended."""
    window = min(_SMOOTHING, len(reward))
    number = np.convolve(np.isfinite(reward), np.ones(window), mode="valid")
    total = np.convolve(np.nan_to_num(reward), np.ones(window), mode="valid")
    return np.where(number > 0, total / np.maximum(number, 1), np.nan)


def _explored(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Epochs at whose end running means of exploring episodes stand, and these means."""
    shown = np.array([_smoothed(of_seed) for of_seed in values])
    return np.arange(values.shape[1] - shown.shape[1], values.shape[1]), shown


def _evaluated(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Epochs in which a learned policy was played, and its rewards."""
    epochs = np.flatnonzero(np.isfinite(values).any(axis=0))
    return epochs, values[:, epochs]


_KINDS = {
    "reward": _Kind("exploring", _EXPLORING, _explored),
    "evaluation": _Kind("without exploration", policy_colour("latent"), _evaluated),
}


def calibration(config: Config, reliability: Mapping[str, Reliability], belief: Beliefs) -> Figure:
    """Whether probabilities are right: of the detectors, and of the map after several looks.

    Args:
      config: all settings.
      reliability: for each modality the points of its diagram.
      belief: the block `belief` of the summary.
    """
    figure = Figure(figsize=(10, 4), layout="constrained")
    left, right = figure.subplots(1, 2)
    left.plot([0, 1], [0, 1], ":", color=SOFT)
    style = {"textcoords": "offset points", "va": "top", "color": SOFT}
    left.annotate("calibrated", (0.7, 0.7), (6, -2), **style)
    for i, (name, of_detector) in enumerate(reliability.items()):
        _draw_detector(left, i, name, of_detector)
    lowest = 1 / max(len(config.labels(name)) for name in reliability)
    left.set(xlabel="confidence of a detector", ylabel="share of right labels")
    left.set(xlim=(lowest - 0.02, 1.02), ylim=(min(lowest, 0.5) - 0.1, 1.02))
    right.plot(belief["looks"], belief["nll"], "o-", color=policy_colour("latent"), label="map")
    style = {"color": policy_colour("bayes"), "markersize": 9, "markerfacecolor": "none"}
    right.plot(belief["looks"], belief["bayes_nll"], "s--", label="exact Bayes", **style)
    right.set(xlabel="looks", ylabel="NLL of the true class [nats]", yscale="log")
    right.set_xticks(belief["looks"])
    right.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    right.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    right.yaxis.set_minor_formatter(NullFormatter())
    for ax in (left, right):
        ax.grid(alpha=0.3)
        # Above the axis, where it hides nothing.
        style = {"fontsize": 9, "columnspacing": 1.0, "frameon": False}
        ax.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=3, borderaxespad=0.2, **style)
    return figure


def _draw_detector(ax: Axes, modality: int, name: str, found: Reliability) -> None:
    """Draws the reliability of a detector; its bins of few looks tell nothing."""
    is_shown = found.looks >= _MIN_LOOKS
    confidence, accuracy = found.confidence[is_shown], found.accuracy[is_shown]
    share = found.looks[is_shown] / np.sum(found.looks)
    colour = modality_colour(modality)
    if len(confidence) == 1:
        name += f": {100 * share[0]:.0f} % at {confidence[0]:.3f}"
    marker = MARKERS[modality % len(MARKERS)]
    style = {"color": colour, "marker": marker, "markersize": 4, "linewidth": 1}
    ax.plot(confidence, accuracy, label=name, markerfacecolor="none", **style)
    # Hollow, for most lie on top of each other where detectors are confident.
    ax.scatter(confidence, accuracy, 10 + 300 * share, facecolors="none", edgecolors=colour)
