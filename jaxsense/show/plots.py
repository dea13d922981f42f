"""The plots of a training: the paper's Fig. 4 and Fig. 5, scans, and calibration."""

import io
import math
from collections.abc import Mapping, Sequence

import jax
import numpy as np
from matplotlib import cm, colormaps
from matplotlib.axes import Axes
from matplotlib.collections import PatchCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse
from matplotlib.patheffects import withStroke

from jaxsense.config import Config
from jaxsense.core.types import Belief, Reliability
from jaxsense.show import mission_plots
from jaxsense.show.colours import (
    MARKERS,
    RGB,
    as_srgb,
    class_colour,
    in_plane,
    plane,
    policy_colour,
)
from jaxsense.summary.blocks import AGENTS, Agent, Beliefs, Learned, Missions
from jaxsense.summary.compare import bounds
from jaxsense.summary.metrics import mean

Arrays = dict[str, np.ndarray]
Curves = dict[str, Arrays]
"""For each Q-network, named by its modality or `team`, `[epochs]` or `[K, epochs]` mean total
rewards: `reward` of the exploring policy, and `evaluation` of the learned policy alone on the map,
NaN where it was not played."""

_MAX_ELLIPSES = 40
_COLUMNS = 4  # of pictures of classes
_SMOOTHING = 20  # epochs
_MIN_LOOKS = 20  # in a bin of the calibration
_MANY_CLASSES = 9
_MANY_TOGETHER = 2  # classes in one place, above which their numbers take too much room
_FAR = 0.2  # from the median of its class, in sigma; detections further away are outliers


def of_run(
    config: Config,
    results: Learned,
    posteriors: dict[str, Belief],
    windows: Arrays,
    reliability: Mapping[str, Reliability],
) -> dict[str, bytes]:
    """Draws the plots that only a run of one seed has, as PNG files by name.

    Args:
      config: all settings.
      results: the blocks of the summary.
      posteriors: see `latent_space`.
      windows: see `scanlines`.
      reliability: see `calibration`.
    """
    return {
        "latent_space.png": png(latent_space(config, posteriors)),
        "scanlines.png": png(scanlines(config, windows)),
        "calibration.png": png(calibration(config, reliability, results["belief"])),
    }


def of_learning(curves: Curves, results: Learned) -> dict[str, bytes]:
    """Draws the plots of a training that a run and several seeds share, as PNG files by name.

    Args:
      curves: see `rewards`.
      results: the blocks of the summary.
    """
    return {"reward.png": png(rewards(curves, results["dqn"]))}


def of_missions(missions: Missions) -> dict[str, bytes]:
    """Draws the plots of missions that a run and several seeds share, as PNG files by name.

    Args:
      missions: the block `mission` of the summary.
    """
    return {"policies.png": png(mission_plots.policies(missions))}


def png(figure: Figure) -> bytes:
    """A figure as a PNG file."""
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=120)
    return content.getvalue()


def latent_space(config: Config, posteriors: dict[str, Belief]) -> Figure:
    """The paper's Fig. 4: posteriors of held-out detections as 1-sigma ellipses.

    Colours show classes above and `||sigma||` below. The first column shows detections by all
    modalities together, the others by each alone, in the two latent dimensions that show classes
    farthest apart. Crosses mark detections far from the others of their class.

    Args:
      config: all settings.
      posteriors: for `joint` and for each modality `[C, S, D]` beliefs.
    """
    names = ["joint", *config.modalities]
    titles = {"joint": " & ".join(config.modalities)}
    figure = Figure(figsize=(3.6 * len(names) + 1.2, 7.6), layout="constrained")
    axes = figure.subplots(2, len(names), sharex=True, sharey=True, squeeze=False)
    shown = {n: jax.tree.map(lambda x: x[:, :_MAX_ELLIPSES], posteriors[n]) for n in names}
    norms = {name: np.linalg.norm(belief.std, axis=-1) for name, belief in shown.items()}
    scale = Normalize(min(x.min() for x in norms.values()), max(x.max() for x in norms.values()))
    sigma_map = colormaps["viridis"]
    classes = config.arena.classes
    colours = [class_colour(config.arena, label) for label in classes]
    dimensions = plane(np.mean(posteriors["joint"].mean, axis=1))
    flat = {n: jax.tree.map(lambda x: in_plane(x, dimensions), b) for n, b in shown.items()}
    num_far = 0
    for column, (name, belief) in zip(axes.T, flat.items(), strict=True):
        column[0].set_title(titles.get(name, f"{name} alone"))
        num_far += _beliefs(column, belief, classes, colours, sigma_map(scale(norms[name])))
    for c, (colour, label) in enumerate(zip(colours, classes, strict=True)):
        axes[0, 0].plot([], [], "o", color=colour, label=f"({c + 1}) {label}")
    if num_far:
        total = sum(norm.size for norm in norms.values())
        label = f"{num_far} of {total} detections, far from most of their class"
        axes[0, 0].plot([], [], "x", color="0.3", label=label)
    first, second = (f"$\\mu_{{{d + 1}}}$" for d in (*dimensions, 1)[:2])
    axes[0, 0].set_ylabel(f"class\n{second}")
    axes[1, 0].set_ylabel(f"uncertainty\n{second}")
    for ax in axes[1]:
        ax.set_xlabel(first)
    _fit(axes, [*flat.values()])
    mappable = cm.ScalarMappable(scale, sigma_map)
    figure.colorbar(mappable, ax=axes[1, :], label="$\\|\\sigma\\|_2$")
    columns = min(len(classes) + bool(num_far), _COLUMNS)
    figure.legend(loc="outside upper center", ncols=columns, frameon=False)
    return figure


def _beliefs(
    axes: Sequence[Axes],
    belief: Belief,
    classes: Sequence[str],
    by_class: list[RGB],
    by_sigma: np.ndarray,
) -> int:
    """Draws `[C, S, 2]` beliefs on two axes; returns how many lie far from their class."""
    mean, std = np.asarray(belief.mean), np.asarray(belief.std)
    centre, spread = np.median(mean, axis=1), np.median(std, axis=1)
    is_far = _apart(mean, centre[:, None], spread[:, None]) > _FAR
    for c, colour in enumerate(by_class):
        _ellipses(axes[0], mean[c], std[c], np.tile(colour, (mean.shape[1], 1)), is_far[c])
        _ellipses(axes[1], mean[c], std[c], by_sigma[c], is_far[c])
    _name_classes(axes[0], centre, spread, classes)
    return int(is_far.sum())


def _fit(axes: np.ndarray, beliefs: list[Belief]) -> None:
    """Limits the axes to a square around all ellipses, with room for the names of classes."""
    means, radii = [belief.mean for belief in beliefs], [belief.std for belief in beliefs]
    low = np.min(np.subtract(means, radii), axis=(0, 1, 2))
    high = np.max(np.add(means, radii), axis=(0, 1, 2))
    half = 0.63 * np.max(high - low)
    x, y = (low + high) / 2
    axes[0, 0].set(xlim=(x - half, x + half), ylim=(y - half, y + half))
    for ax in axes.flat:
        ax.set_aspect("equal", adjustable="box")


def _apart(mean: np.ndarray, centre: np.ndarray, spread: np.ndarray) -> np.ndarray:
    """Distance of `[..., 2]` means from a centre, in standard deviations."""
    return np.linalg.norm((mean - centre) / np.maximum(spread, 1e-6), axis=-1)


def _ellipses(
    axes: Axes, mean: np.ndarray, std: np.ndarray, colours: np.ndarray, is_far: np.ndarray
) -> None:
    """Ellipses and their centres, `[S, 2]`, in the colours `[S, 3 or 4]`; crosses if far `[S]`."""
    for marker, line, chosen in ((".", "-", ~is_far), ("x", ":", is_far)):
        pairs = zip(mean[chosen], std[chosen], strict=True)
        patches = [Ellipse(m, 2 * s[0], 2 * s[1]) for m, s in pairs]
        axes.add_collection(
            PatchCollection(
                patches, facecolors="none", edgecolors=colours[chosen], alpha=0.5, linestyles=line
            )
        )
        axes.scatter(mean[chosen, 0], mean[chosen, 1], s=25, marker=marker, c=colours[chosen])


def _name_classes(
    axes: Axes, centre: np.ndarray, spread: np.ndarray, classes: Sequence[str]
) -> None:
    """Writes the numbers of classes, `[C, 2]`, above their ellipses; joins those in one place."""
    size = 10 if len(classes) <= _MANY_CLASSES else 8
    waiting = list(range(len(centre)))
    while waiting:
        first = waiting[0]
        apart = _apart(centre[waiting], centre[first], spread[first])
        together = [c for c, distance in zip(waiting, apart, strict=True) if distance < _FAR]
        waiting = [c for c in waiting if c not in together]
        name = axes.annotate(
            _name(together, classes),
            (centre[first, 0], centre[first, 1] + max(spread[c, 1] for c in together)),
            (0, 4),
            textcoords="offset points",
            ha="center",
            va="bottom",
            weight="bold",
            fontsize=size,
            path_effects=[withStroke(linewidth=3, foreground="white")],
        )
        # Room for a long name would leave none for the axes.
        name.set_in_layout(False)


def _name(together: list[int], classes: Sequence[str]) -> str:
    """Numbers of classes, or of many what they have in common."""
    if len(together) <= _MANY_TOGETHER:
        return " & ".join(f"({c + 1})" for c in together)
    first, *others = (classes[c].split(" ") for c in together)
    shared = [word for word in first if all(word in other for other in others)]
    return " ".join(shared) or f"{len(together)} classes"


def rewards(curves: Curves, agents: Mapping[str, Agent]) -> Figure:
    """The paper's Fig. 5: reward of whole episodes over the epochs, with other policies as lines.

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
    for ax, (title, of_panel, agent) in zip(axes, panels, strict=True):
        for kind, values in of_panel.items():
            _draw_rewards(ax, kind, np.atleast_2d(values))
        if agent is not None:
            _draw_references(ax, agent)
        ax.set(title=title, xlabel="epoch", ylabel="total reward of an episode")
        ax.grid(alpha=0.3)
        ax.legend(loc="lower right")
    return figure


def _draw_rewards(ax: Axes, kind: str, values: np.ndarray) -> None:
    """Draws `[K, epochs]` rewards: the mean, and of several seeds its 95% interval."""
    if len(values) == 0:
        return
    if kind == "reward":
        colour, label = "0.6", "exploring"
        shown = np.array([_smoothed(of_seed) for of_seed in values])
        epochs = np.arange(values.shape[1] - shown.shape[1], values.shape[1])
    else:
        colour, label = "C0", "without exploration"
        epochs = np.flatnonzero(np.isfinite(values).any(axis=0))
        shown = values[:, epochs]
    ax.plot(epochs, shown.mean(axis=0), color=colour, label=label, linewidth=1.2)
    if len(shown) > 1:
        low, high = bounds(shown)
        ax.fill_between(epochs, low, high, color=colour, alpha=0.2, linewidth=0)


def _draw_references(ax: Axes, agent: Agent) -> None:
    """Draws the policies that an agent is compared with; random ones are far below."""
    naive, random = mean(agent["naive"]), mean(agent["random"])
    optimal = naive if agent["optimal"] is None else mean(agent["optimal"])
    if agent["optimal"] is not None:
        ax.axhline(optimal, color="C2", linestyle="--", label=AGENTS["optimal"].label)
    ax.axhline(naive, color=policy_colour("naive"), linestyle=":", label=AGENTS["naive"].label)
    bottom = min(naive, mean(agent["return"])) - max(0.5, optimal - naive)
    ax.set_ylim(bottom=bottom)
    if random < bottom:
        ax.plot([], [], " ", label=f"random: {random:.2f}")
    else:
        ax.axhline(random, color=policy_colour("random"), linestyle=(0, (1, 4)), label="random")


def _smoothed(reward: np.ndarray) -> np.ndarray:
    """Running mean over the epochs in which an episode ended."""
    window = min(_SMOOTHING, len(reward))
    number = np.convolve(np.isfinite(reward), np.ones(window), mode="valid")
    total = np.convolve(np.nan_to_num(reward), np.ones(window), mode="valid")
    return np.where(number > 0, total / np.maximum(number, 1), np.nan)


def scanlines(config: Config, windows: Arrays) -> Figure:
    """One look at each class as each detector reads it, from left to right.

    Args:
      config: all settings.
      windows: for each modality `[C, window, channels]` readings, from left to right.
    """
    classes = config.arena.classes
    columns = min(len(classes), _COLUMNS)
    lines = math.ceil(len(classes) / columns)
    heights = [0.8 if x.shape[-1] == 3 else 2.2 for x in windows.values() for _ in range(lines)]
    figure = Figure(figsize=(3.2 * columns, sum(heights) + 0.6), layout="constrained")
    axes = figure.subplots(len(heights), columns, squeeze=False, height_ratios=heights)
    for m, (name, readings) in enumerate(windows.items()):
        rows = axes[m * lines : (m + 1) * lines].ravel()
        top = 1.05 * np.max(readings, initial=0.0, where=np.isfinite(readings))
        for ax, label, values in zip(rows, classes, readings, strict=False):
            ax.set_title(f"{name}: {label}", fontsize=10)
            if readings.shape[-1] == 3:  # an image
                ax.imshow(as_srgb(values)[None], aspect="auto", interpolation="nearest")
                ax.set(yticks=[], xticks=[])
            else:
                ax.plot(values, ".", color=class_colour(config.arena, label), markersize=3)
                ax.set(ylim=(0, top or 1.0))
        for ax in rows[len(classes) :]:
            ax.set_axis_off()
    figure.supxlabel("rays of the window, from left to right; distances in metres", fontsize=10)
    return figure


def calibration(config: Config, reliability: Mapping[str, Reliability], belief: Beliefs) -> Figure:
    """Whether probabilities are right: of the detectors, and of the map after several looks.

    Args:
      config: all settings.
      reliability: for each modality the points of its diagram.
      belief: the block `belief` of the summary.
    """
    figure = Figure(figsize=(10, 4), layout="constrained")
    left, right = figure.subplots(1, 2)
    left.plot([0, 1], [0, 1], ":", color="0.5", label="calibrated")
    for i, (name, of_detector) in enumerate(reliability.items()):
        is_shown = of_detector.looks >= _MIN_LOOKS
        confidence, accuracy = of_detector.confidence[is_shown], of_detector.accuracy[is_shown]
        share = of_detector.looks[is_shown] / np.sum(of_detector.looks)
        style = {"color": f"C{i}", "marker": MARKERS[i % 4], "markersize": 4, "linewidth": 1}
        left.plot(confidence, accuracy, label=name, markerfacecolor="none", **style)
        # Hollow, for most lie on top of each other where detectors are confident.
        left.scatter(confidence, accuracy, 10 + 300 * share, facecolors="none", edgecolors=f"C{i}")
    lowest = 1 / max(len(config.labels(name)) for name in reliability)
    left.set(xlabel="confidence", ylabel="share of right labels", title="detectors")
    left.set(xlim=(lowest - 0.02, 1.02), ylim=(min(lowest, 0.5) - 0.1, 1.02))
    right.plot(belief["looks"], belief["nll"], "o-", label="map")
    right.plot(belief["looks"], belief["bayes_nll"], "x--", label="exact Bayes")
    right.set(xlabel="looks", ylabel="NLL of the true class [nats]", title="beliefs", yscale="log")
    for ax in (left, right):
        ax.grid(alpha=0.3)
        ax.legend()
    return figure
