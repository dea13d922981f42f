"""The plots of a run: latent space, looks, calibration, learning, and policies in missions."""

from collections.abc import Mapping, Sequence
from typing import Any, cast

import jax
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import PatchCollection
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from jaxsense.config import Config
from jaxsense.core.types import Belief, Fusion, Reliability
from jaxsense.exploration import ExplorationState
from jaxsense.exploration import slots as objects
from jaxsense.show.colours import (
    MARKERS,
    SOFT,
    as_srgb,
    class_colour,
    in_plane,
    modality_colour,
    plane,
    policy_colour,
)
from jaxsense.summary.blocks import (
    AGENTS,
    MISSIONS,
    Agent,
    Beliefs,
    Missions,
    Number,
    mean,
)
from jaxsense.summary.blocks import policies as policies_of
from jaxsense.summary.compare import bounds

Arrays = dict[str, np.ndarray]
Curves = dict[str, Arrays]
"""For each Q-network, named by its modality or `team`, `[epochs]` or `[K, epochs]` mean total
rewards: `reward` of the exploring policy, and `evaluation` of the learned policy alone on the map,
NaN where it was not played."""

_MOST = 20  # ellipses of a class
_CLASS_ROW = 0.24  # inches, of a class in the plot of sigma
_LOOK_ROW = 0.8  # inches, of a look
_SMOOTHING = 20  # epochs
_EXPLORED = (
    "dark grey: unknown; light grey: free, not seen; black: walls as scanned; lines: walls; "
    "+ points of interest; ellipses: on the map, dotted if in doubt; dots: robots"
)
_HEADING = 0.4  # m
_TRUTH = "#e0218a"
_LIKELY = 0.9  # probability of a class that has a colour on the map
_MIN_LOOKS = 20  # in a bin of the calibration
_REFERENCES = {"optimal": "--", "naive": ":", "random": (0, (1, 4))}
_BESIDE = {"loc": "upper left", "bbox_to_anchor": (1, 1), "frameon": False, "fontsize": 9}
_ABOVE = {"loc": "lower left", "bbox_to_anchor": (0, 1), "frameon": False, "fontsize": 9}


def latent_space(config: Config, posteriors: dict[str, Belief]) -> Figure:
    """The paper's Fig. 4: posteriors of held-out detections as 1-sigma ellipses, and `||sigma||`.

    The first column shows detections by all modalities together, the others by each alone, in the
    two latent dimensions that show classes farthest apart. Markers and colours of classes are those
    below, beside their names.

    Args:
      posteriors: for `joint` and for each modality `[C, S, D]` beliefs.
    """
    names, classes = ["joint", *config.modalities], config.arena.classes
    rows = _CLASS_ROW * len(classes) + 0.2
    figure = Figure(figsize=(3.6 * len(names) + 1.2, 4.6 + rows), layout="compressed")
    above, below = figure.subplots(
        2, len(names), squeeze=False, sharex="row", sharey="row", height_ratios=(3.6, rows)
    )
    shown = {n: jax.tree.map(lambda x: np.asarray(x)[:, :_MOST], posteriors[n]) for n in names}
    colours = [class_colour(config.arena, label) for label in classes]
    dimensions = plane(np.mean(posteriors["joint"].mean, axis=1))
    flat = {n: jax.tree.map(lambda x: in_plane(x, dimensions), b) for n, b in shown.items()}
    for top, bottom, name in zip(above, below, names, strict=True):
        top.set_title(" & ".join(config.modalities) if name == "joint" else f"{name} alone")
        _draw_beliefs(top, flat[name], colours)
        _draw_norms(bottom, np.linalg.norm(shown[name].std, axis=-1), colours)
        top.set_xlabel(f"latent dimension {dimensions[0] + 1}")
        top.set_aspect("equal", adjustable="box")
        bottom.set_xlabel("norm of sigma of each detection")
    above[0].set_ylabel(f"latent dimension {(*dimensions, 1)[1] + 1}")
    below[0].set_yticks(range(len(classes)), classes)
    below[0].set_ylim(len(classes) - 0.5, -0.5)
    # A square around all ellipses.
    low = np.min([belief.mean - belief.std for belief in flat.values()], axis=(0, 1, 2))
    high = np.max([belief.mean + belief.std for belief in flat.values()], axis=(0, 1, 2))
    (x, y), half = (low + high) / 2, 0.55 * np.max(high - low)
    above[0].set(xlim=(x - half, x + half), ylim=(y - half, y + half))
    return figure


def _draw_beliefs(ax: Axes, belief: Belief, colours: Sequence[str]) -> None:
    """Draws `[C, S, 2]` beliefs."""
    mean, std = np.asarray(belief.mean), np.asarray(belief.std)
    for c, colour in enumerate(colours):
        style: dict[str, Any] = {"facecolors": "none", "edgecolors": colour}
        patches = [Ellipse(m, *(2 * s)) for m, s in zip(mean[c], std[c], strict=True)]
        ax.add_collection(PatchCollection(patches, alpha=0.5, **style))
        # Hollow and of another shape, so that classes in one place are all seen.
        ax.scatter(*mean[c].T, s=30, marker=MARKERS[c % len(MARKERS)], linewidths=1.0, **style)


def _draw_norms(ax: Axes, norms: np.ndarray, colours: Sequence[str]) -> None:
    """Draws `[C, S]` norms of sigma, a row for each class."""
    for c, of_class in enumerate(norms):
        # Side by side across the row, so that equal ones are seen.
        heights = c + np.linspace(-0.25, 0.25, len(of_class))
        style = {"facecolors": "none", "edgecolors": colours[c], "linewidths": 0.8}
        ax.scatter(of_class, heights, s=14, marker=MARKERS[c % len(MARKERS)], **style)
    ax.grid(axis="x", alpha=0.3)


def scanlines(config: Config, windows: Mapping[str, np.ndarray]) -> Figure:
    """One look at each class as each detector reads it, from left to right.

    Dashed lines mark the bearing of the PoI, where robots expect its centre. All distances have one
    scale.

    Args:
      windows: for each modality `[C, window, channels]` readings, from left to right.
    """
    classes = config.arena.classes
    figure = Figure(figsize=(9, _LOOK_ROW * len(classes) + 0.8), layout="constrained")
    axes = figure.subplots(len(classes), len(windows), squeeze=False, sharex="col")
    for c, (label, row) in enumerate(zip(classes, axes, strict=True)):
        row[0].set_ylabel(label, rotation=0, ha="right", va="center")
        for ax, readings in zip(row, windows.values(), strict=True):
            _draw_look(ax, readings, c, class_colour(config.arena, label))
    for ax, name in zip(axes[0], windows, strict=True):
        ax.set_title(name)
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
    axes = figure.subplots(1, len(panels), squeeze=False, sharey="team" not in curves)[0]
    bottom = min(_bottom(agent) for *_, agent in panels if agent is not None)
    for ax, (title, of_panel, agent) in zip(axes, panels, strict=True):
        for kind, values in of_panel.items():
            _draw_rewards(ax, kind, np.atleast_2d(values))
        for name, line in _REFERENCES.items():
            if agent is not None and agent[name] is not None:
                height = mean(agent[name])
                label = AGENTS[name].label
                label += f": {height:.2f}, below" if height < bottom else ""
                ax.axhline(height, color=policy_colour(name), linestyle=line, label=label)
        ax.set(title=title, xlabel="epoch", ylabel="total reward of an episode")
        ax.set_ylim(bottom=bottom if agent is not None else None)
        ax.grid(alpha=0.3)
        ax.legend(**_BESIDE)
    return figure


def _bottom(agent: Agent) -> float:
    """Where the axis of an agent begins; random policies are far below."""
    naive = mean(agent["naive"])
    optimal = naive if agent["optimal"] is None else mean(agent["optimal"])
    return min(naive, mean(agent["return"])) - max(0.5, optimal - naive)


def _draw_rewards(ax: Axes, kind: str, values: np.ndarray) -> None:
    """Draws `[K, epochs]` rewards: the mean, and of several seeds its 95% interval."""
    if len(values) == 0:
        return
    if kind == "evaluation":
        epochs = np.flatnonzero(np.isfinite(values).any(axis=0))
        shown, label, colour = values[:, epochs], "without exploration", policy_colour("latent")
    else:
        shown, label, colour = np.array([*map(_smoothed, values)]), "exploring", "#8c8c8c"
        epochs = np.arange(values.shape[1] - shown.shape[1], values.shape[1])
    ax.plot(epochs, shown.mean(axis=0), color=colour, label=label, linewidth=1.2)
    if len(shown) > 1:
        ax.fill_between(epochs, *bounds(shown), color=colour, alpha=0.2, linewidth=0)


def _smoothed(reward: np.ndarray) -> np.ndarray:
    """Running mean over the epochs in which an episode ended."""
    window = np.ones(min(_SMOOTHING, len(reward)))
    number = np.convolve(np.isfinite(reward), window, mode="valid")
    total = np.convolve(np.nan_to_num(reward), window, mode="valid")
    return np.where(number > 0, total / np.maximum(number, 1), np.nan)


def calibration(config: Config, reliability: Mapping[str, Reliability], belief: Beliefs) -> Figure:
    """Whether probabilities are right: of the detectors, and of the map after several looks.

    Args:
      reliability: for each modality the points of its diagram.
      belief: the block `belief` of the summary.
    """
    figure = Figure(figsize=(10, 4), layout="constrained")
    left, right = figure.subplots(1, 2)
    left.plot([0, 1], [0, 1], ":", color=SOFT, label="calibrated")
    for i, (name, found) in enumerate(reliability.items()):
        is_shown = found.looks >= _MIN_LOOKS  # bins of few looks tell nothing
        confidence, accuracy = found.confidence[is_shown], found.accuracy[is_shown]
        share = found.looks[is_shown] / np.sum(found.looks)
        colour, marker = modality_colour(i), MARKERS[i % len(MARKERS)]
        left.plot(confidence, accuracy, marker + "-", color=colour, label=name, markersize=4)
        # Hollow, for most lie on top of each other where detectors are confident.
        size = 10 + 300 * share
        left.scatter(confidence, accuracy, size, facecolors="none", edgecolors=colour)
    lowest = 1 / max(len(config.labels(name)) for name in reliability)
    left.set(xlabel="confidence of a detector", ylabel="share of right labels")
    left.set(xlim=(lowest - 0.02, 1.02), ylim=(min(lowest, 0.5) - 0.1, 1.02))
    right.plot(belief["looks"], belief["nll"], "o-", color=policy_colour("latent"), label="map")
    style = {"color": policy_colour("bayes"), "markersize": 9, "markerfacecolor": "none"}
    right.plot(belief["looks"], belief["bayes_nll"], "s--", label="exact Bayes", **style)
    right.set(xlabel="looks", ylabel="NLL of the true class [nats]", yscale="log")
    right.set_xticks(belief["looks"])
    for ax in (left, right):
        ax.grid(alpha=0.3)
        ax.legend(ncols=3, **_ABOVE)
    return figure


def policies(block: Missions) -> Figure:
    """Looks and time of every policy, the slowest last, with 95% intervals, and its wrong PoIs.

    The intervals are of the paired differences from the latent policy; with several seeds, of the
    means.
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
        ax.set(xlabel=MISSIONS[key].label, ylim=(-0.7, len(names) - 0.3))
        ax.set_xlim(0, 1.05 * ax.dataLim.x1)
        ax.grid(axis="x", alpha=0.3)
    axes[0].set_yticks(range(len(names)), names)
    for y, name in enumerate(names):
        wrong = f"{100 * (1 - mean(played[name]['accuracy'])):.1f} % of PoIs wrong"
        place = axes[1].get_yaxis_transform()
        axes[1].text(1.02, y, wrong, transform=place, va="center", color=SOFT)
    return figure


def _error(value: Number, difference: Number | None) -> list[list[float]] | None:
    """Ends of a bar, from the interval of a value or else of its difference."""
    found = value if isinstance(value, dict) else difference
    match found:
        case {"mean": float(middle), "low": float(low), "high": float(high)}:
            return [[max(0.0, middle - low)], [max(0.0, high - middle)]]
    return None


def explored(config: Config, fusion: Fusion, states: Sequence[ExplorationState]) -> Figure:
    """One mission in an unknown place, at four times: what robots know, before what is there.

    Ellipses are a body's radius and 2 sigma of each slot's position, dotted for slots in doubt, and
    coloured once a class is likely.
    """
    shown = [states[round(i)] for i in np.linspace(0, len(states) - 1, min(4, len(states)))]
    figure = Figure(figsize=(3.4 * len(shown), 3.9), layout="compressed")
    half, dots = config.arena.side / 2, dict[str, Artist]()
    for ax, state in zip(figure.subplots(1, len(shown), squeeze=False)[0], shown, strict=True):
        grid, slots, layout = state.grid, state.slots, state.scene.layout
        floor = np.select([grid.evidence > 0, grid.evidence < 0], [0.1, 1.0], 0.6)
        seen = np.any(grid.seen, axis=0)
        floor[(grid.evidence < 0) & ~seen] = 0.85
        extent = (-half, half, -half, half)
        ax.imshow(floor.T, origin="lower", extent=extent, cmap="gray", vmin=0, vmax=1)
        for x, y, yaw, long in layout.walls:
            ends = long * np.array([-1, 1])
            ax.plot(x + ends * np.cos(yaw), y + ends * np.sin(yaw), color=SOFT, linewidth=0.8)
        ax.plot(*layout.position[layout.present].T, "+", color=_TRUTH, markersize=6, zorder=3)
        probabilities = np.asarray(jax.vmap(fusion.class_probabilities)(slots.belief))
        is_sure = np.asarray(objects.found(slots))
        for slot in np.flatnonzero(slots.is_used):
            width, axes = np.linalg.eigh(slots.covariance[slot])
            best = int(np.argmax(probabilities[slot]))
            is_likely = probabilities[slot, best] > _LIKELY
            label, style = config.arena.classes[best], "-" if is_sure[slot] else ":"
            colour = class_colour(config.arena, label) if is_likely else SOFT
            turn = np.degrees(np.arctan2(axes[1, 1], axes[0, 1]))
            size = 2 * config.arena.poi_radius + 4 * np.sqrt(width[::-1])
            ax.add_patch(
                Ellipse(
                    slots.position[slot],
                    *size,
                    angle=turn,
                    fill=False,
                    edgecolor=colour,
                    linestyle=style,
                )
            )
        for (x, y, yaw), modality in zip(state.scene.poses, config.modality_of_robot, strict=True):
            ahead = x + _HEADING * np.cos(yaw), y + _HEADING * np.sin(yaw)
            colour = modality_colour(modality)
            ax.plot(*zip((x, y), ahead, strict=True), color=colour)
            dots[config.modalities[modality]], *_ = ax.plot(x, y, "o", color=colour)
        ax.set(xlim=(-half, half), ylim=(-half, half), title=f"{float(state.time):.0f} s")
        ax.set(xticks=[], yticks=[])
    figure.legend(dots.values(), dots, loc="outside upper right", ncols=len(dots), frameon=False)
    figure.supxlabel(_EXPLORED, fontsize=8)
    return figure
