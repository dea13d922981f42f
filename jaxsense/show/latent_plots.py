"""The plot of the latent space: the paper's Fig. 4."""

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PatchCollection
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse
from matplotlib.patheffects import withStroke

from jaxsense.config import Config
from jaxsense.core.types import Belief
from jaxsense.show.colours import MARKERS, class_colour, in_plane, plane

_MOST = 20  # ellipses of a class
_MANY_CLASSES = 9
_MANY_TOGETHER = 3  # classes in one place, above which their names take too much room
_NEAR = 0.2  # sigma, between classes in one place
_DASH = 5.0  # points, of ellipses of classes in one place
_ROW = 0.24  # inches, of a class in the plot of sigma


def latent_space(config: Config, posteriors: dict[str, Belief]) -> Figure:
    """The paper's Fig. 4: posteriors of held-out detections as 1-sigma ellipses, and `||sigma||`.

    The first column shows detections by all modalities together, the others by each alone, in the
    two latent dimensions that show classes farthest apart. Where classes share a place, their
    dashes alternate.

    Args:
      config: all settings.
      posteriors: for `joint` and for each modality `[C, S, D]` beliefs.
    """
    names, classes = ["joint", *config.modalities], config.arena.classes
    rows = _ROW * len(classes) + 0.2
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
        _draw_beliefs(top, flat[name], classes, colours)
        _draw_norms(bottom, np.linalg.norm(shown[name].std, axis=-1), colours)
        top.set_xlabel(f"latent dimension {dimensions[0] + 1}")
        top.set_aspect("equal", adjustable="box")
        bottom.set_xlabel("norm of sigma of each detection")
    above[0].set_ylabel(f"latent dimension {(*dimensions, 1)[1] + 1}")
    below[0].set_yticks(range(len(classes)), classes)
    below[0].set_ylim(len(classes) - 0.5, -0.5)
    # A square around all ellipses, with room for the names of classes.
    low = np.min([belief.mean - belief.std for belief in flat.values()], axis=(0, 1, 2))
    high = np.max([belief.mean + belief.std for belief in flat.values()], axis=(0, 1, 2))
    (x, y), half = (low + high) / 2, 0.68 * np.max(high - low)
    above[0].set(xlim=(x - half, x + half), ylim=(y - half, y + half))
    return figure


def _draw_beliefs(ax: Axes, belief: Belief, classes: Sequence[str], colours: Sequence[str]) -> None:
    """Draws `[C, S, 2]` beliefs and the names of their classes."""
    mean, std = np.asarray(belief.mean), np.asarray(belief.std)
    centre, spread = np.median(mean, axis=1), np.median(std, axis=1)
    for together in _groups(centre, spread):
        for place, c in enumerate(together):
            dash = (place * _DASH, (_DASH, _DASH * (len(together) - 1)))
            style: dict[str, Any] = {"facecolors": "none", "edgecolors": colours[c]}
            patches = [Ellipse(m, *(2 * s)) for m, s in zip(mean[c], std[c], strict=True)]
            line = "-" if len(together) == 1 else dash
            ax.add_collection(PatchCollection(patches, alpha=0.5, linestyles=[line], **style))
            # Hollow and of another shape, so that classes in one place are all seen.
            ax.scatter(*mean[c].T, s=30, marker=MARKERS[c % len(MARKERS)], linewidths=1.0, **style)
        first, names = together[0], [classes[c] for c in together]
        if len(names) > _MANY_TOGETHER:
            names[_MANY_TOGETHER - 1 :] = [f"{len(names) - _MANY_TOGETHER + 1} more"]
        name = ax.annotate(
            "\n".join(names),
            (centre[first, 0], centre[first, 1] + max(spread[c, 1] for c in together)),
            (0, 4),
            textcoords="offset points",
            ha="center",
            va="bottom",
            fontsize=9 if len(classes) <= _MANY_CLASSES else 6.5,
            path_effects=[withStroke(linewidth=3, foreground="white")],
        )
        # Room for a long name would leave none for the axes.
        name.set_in_layout(False)


def _draw_norms(ax: Axes, norms: np.ndarray, colours: Sequence[str]) -> None:
    """Draws `[C, S]` norms of sigma, a row for each class."""
    for c, of_class in enumerate(norms):
        # Side by side across the row, so that equal ones are seen.
        heights = c + np.linspace(-0.25, 0.25, len(of_class))
        style = {"facecolors": "none", "edgecolors": colours[c], "linewidths": 0.8}
        ax.scatter(of_class, heights, s=14, marker=MARKERS[c % len(MARKERS)], **style)
    ax.grid(axis="x", alpha=0.3)


def _groups(centre: np.ndarray, spread: np.ndarray) -> list[list[int]]:
    """Classes with `[C, 2]` centres, those in one place together."""
    found, waiting = [], list(range(len(centre)))
    while waiting:
        first = waiting[0]
        apart = (centre[waiting] - centre[first]) / np.maximum(spread[first], 1e-6)
        is_near = np.linalg.norm(apart, axis=-1) < _NEAR
        found.append([c for c, near in zip(waiting, is_near, strict=True) if near])
        waiting = [c for c in waiting if c not in found[-1]]
    return found
