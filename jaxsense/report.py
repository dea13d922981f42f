"""The plots of a run: the latent space, the rewards, and what the sensors see.

The first two are the paper's Fig. 4 and Fig. 5.
"""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import cm, colormaps
from matplotlib.collections import PatchCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from jaxsense.config import Config
from jaxsense.pipeline import RunResult
from jaxsense.types import Belief

_MOST_ELLIPSES = 40
_SMOOTHING = 20  # epochs


def write_plots(path: Path, config: Config, result: RunResult) -> None:
    """Writes `latent_space.png`, `reward.png` and `scanlines.png` into a directory."""
    plots = {
        "latent_space": latent_space(config, result.posteriors),
        "reward": rewards(result.rewards, result.summary["dqn"]),
        "scanlines": scanlines(config, result.windows),
    }
    for name, figure in plots.items():
        figure.savefig(path / f"{name}.png", dpi=120)


def latent_space(config: Config, posteriors: dict[str, Belief]) -> Figure:
    """The paper's Fig. 4: posteriors of held-out detections as 1-sigma ellipses.

    Above, classes by colour; below, `||sigma||` by colour; one column for detections by all
    modalities together, and one for each alone. Of a latent space of more than two dimensions the
    first two are shown.
    """
    names = ["joint", *config.modalities]
    titles = {"joint": " & ".join(config.modalities)}
    figure = Figure(figsize=(3.6 * len(names) + 1.2, 7.4), layout="constrained")
    axes = figure.subplots(2, len(names), sharex=True, sharey=True, squeeze=False)
    norms = {name: np.linalg.norm(belief.std, axis=-1) for name, belief in posteriors.items()}
    lowest = min(norm[:, :_MOST_ELLIPSES].min() for norm in norms.values())
    highest = max(norm[:, :_MOST_ELLIPSES].max() for norm in norms.values())
    scale = Normalize(lowest, highest)
    sigma_map = colormaps["viridis"]
    for column, name in enumerate(names):
        belief = posteriors[name]
        axes[0, column].set_title(titles.get(name, f"{name} alone"))
        for c, label in enumerate(config.arena.classes):
            mean, std = (np.asarray(x)[c, :_MOST_ELLIPSES, :2] for x in (belief.mean, belief.std))
            if mean.shape[1] == 1:
                mean, std = np.pad(mean, ((0, 0), (0, 1))), np.pad(std, ((0, 0), (0, 1)))
            colour = _colour_of(config, label)
            by_class = [colour] * len(mean)
            by_sigma = sigma_map(scale(norms[name][c, :_MOST_ELLIPSES]))
            for row, colours in enumerate((by_class, by_sigma)):
                _ellipses(axes[row, column], mean, std, colours)
            centre = np.median(mean, axis=0)
            # Classes that a sensor cannot tell apart share a centre; their numbers go side by side.
            offset = (18 * (c - (len(config.arena.classes) - 1) / 2), 0)
            axes[0, column].annotate(
                f"({c + 1})",
                centre,
                offset,
                textcoords="offset points",
                ha="center",
                va="center",
                weight="bold",
            )
            if column == 0:
                axes[0, 0].plot([], [], "o", color=colour, label=f"({c + 1}) {label}")
        axes[1, column].set_xlabel("$\\mu_1$")
    axes[0, 0].set_ylabel("class\n$\\mu_2$")
    axes[1, 0].set_ylabel("uncertainty\n$\\mu_2$")
    axes[0, 0].autoscale_view()
    for ax in axes.flat:
        ax.set_aspect("equal", adjustable="box")
    mappable = cm.ScalarMappable(scale, sigma_map)
    figure.colorbar(mappable, ax=axes[1, :], label="$\\|\\sigma\\|_2$")
    figure.legend(loc="outside upper center", ncols=len(config.arena.classes), frameon=False)
    return figure


def _colour_of(config: Config, label: str) -> np.ndarray:
    """The colour of a class in plots: its own, and half as bright for any shape but the first."""
    colour, shape, *_ = label.split(" ")
    is_first = shape == next(iter(config.arena.shapes))
    return np.array(config.arena.colours[colour]) * (1.0 if is_first else 0.5)


def _ellipses(axes: Any, mean: np.ndarray, std: np.ndarray, colours: Any) -> None:
    patches = [Ellipse(m, 2 * s[0], 2 * s[1]) for m, s in zip(mean, std, strict=True)]
    axes.add_collection(
        PatchCollection(patches, facecolors="none", edgecolors=colours, alpha=0.5, linewidths=1)
    )
    axes.scatter(*mean.T, s=4, c=colours)


def rewards(per_epoch: dict[str, np.ndarray], figures: dict[str, Any]) -> Figure:
    """The paper's Fig. 5: reward of whole episodes over the epochs, with baselines as lines."""
    figure = Figure(figsize=(5 * len(per_epoch), 4), layout="constrained")
    axes = figure.subplots(1, len(per_epoch), squeeze=False)
    for ax, (name, reward) in zip(axes[0], per_epoch.items(), strict=True):
        window = min(_SMOOTHING, len(reward))
        # An epoch in which no episode ended has no reward.
        number = np.convolve(np.isfinite(reward), np.ones(window), mode="valid")
        total = np.convolve(np.nan_to_num(reward), np.ones(window), mode="valid")
        smooth = np.where(number > 0, total / np.maximum(number, 1), np.nan)
        ax.plot(reward, color="C0", alpha=0.25, linewidth=0.8)
        ax.plot(np.arange(window - 1, len(reward)), smooth, color="C0", label="DQN, exploring")
        lines = {"return": "DQN, greedy", "optimal": "optimal", "naive": "naive exploration"}
        for i, (key, label) in enumerate([*lines.items(), ("random", "random")]):
            style = ("-.", "--", ":", (0, (1, 4)))[i]
            ax.axhline(figures[name][key], color=f"C{i + 1}", linestyle=style, label=label)
        ax.set(title=f"{name} DQN", xlabel="epoch", ylabel="total reward of an episode")
        ax.set_ylim(bottom=1.3 * min(figures[name]["random"], -0.1))
        ax.grid(alpha=0.3)
    axes[0, 0].legend(loc="lower right")
    return figure


def scanlines(config: Config, windows: dict[str, np.ndarray]) -> Figure:
    """What each detector reads of one look at each class."""
    classes = config.arena.classes
    figure = Figure(figsize=(3.6 * len(classes), 2.6 * len(windows)), layout="constrained")
    axes = figure.subplots(len(windows), len(classes), squeeze=False)
    for row, (name, window) in zip(axes, windows.items(), strict=True):
        for ax, label, readings in zip(row, classes, window[:, 0], strict=True):
            ax.set_title(f"{name}: {label}")
            if name == "camera":
                ax.imshow(readings.reshape(1, -1, 3), aspect="auto", interpolation="nearest")
                ax.set(yticks=[], xlabel="pixel of the window")
            else:
                ax.plot(readings, ".", color=_colour_of(config, label), markersize=3)
                if name == "lidar":
                    ax.set(xlabel="beam of the window", ylabel="distance [m]", ylim=(0, None))
                else:
                    ax.set(xlabel="reading of the window")
    return figure
