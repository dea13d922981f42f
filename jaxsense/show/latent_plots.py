"""The plot of the latent space: the paper's Fig. 4."""

from collections.abc import Sequence

import jax
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PatchCollection
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse
from matplotlib.patheffects import withStroke

from jaxsense.config import Config
from jaxsense.core.types import Belief
from jaxsense.show.colours import SOFT, as_hex, class_colour, class_marker, in_plane, plane

_MAX_ELLIPSES = 40  # of a class
_MOST_ELLIPSES = 400  # of all classes
_MANY_CLASSES = 9
_MANY_TOGETHER = 3  # classes in one place, above which their names take too much room
_FAR = 0.2  # from the median of its class, in sigma; detections further away are outliers
_DASH = 5.0  # points, of ellipses of classes in one place
_FAINT, _PLAIN, _FEW = 0.15, 0.5, 4  # opacity of many and of few ellipses
_ROW = 0.24  # inches, of a class in the plot of sigma


def latent_space(config: Config, posteriors: dict[str, Belief]) -> Figure:
    """The paper's Fig. 4: posteriors of held-out detections as 1-sigma ellipses, and `||sigma||`.

    The first column shows detections by all modalities together, the others by each alone, in the
    two latent dimensions that show classes farthest apart. Where classes share a place, their
    dashes alternate. Crosses mark detections far from the others of their class.

    Args:
      config: all settings.
      posteriors: for `joint` and for each modality `[C, S, D]` beliefs.
    """
    names, classes = ["joint", *config.modalities], config.arena.classes
    titles = {"joint": " & ".join(config.modalities)}
    rows = _ROW * len(classes) + 0.2
    figure = Figure(figsize=(3.6 * len(names) + 1.2, 4.6 + rows), layout="constrained")
    above, below = figure.subplots(
        2, len(names), squeeze=False, sharex="row", sharey="row", height_ratios=(3.6, rows)
    )
    most = max(1, min(_MAX_ELLIPSES, _MOST_ELLIPSES // len(classes)))
    shown = {n: jax.tree.map(lambda x: np.asarray(x)[:, :most], posteriors[n]) for n in names}
    colours = [as_hex(class_colour(config.arena, label)) for label in classes]
    dimensions = plane(np.mean(posteriors["joint"].mean, axis=1))
    flat = {n: jax.tree.map(lambda x: in_plane(x, dimensions), b) for n, b in shown.items()}
    num_far = 0
    for top, bottom, name in zip(above, below, names, strict=True):
        top.set_title(titles.get(name, f"{name} alone"))
        num_far += _beliefs(top, flat[name], classes, colours)
        _norms(bottom, np.linalg.norm(shown[name].std, axis=-1), colours)
        top.set_xlabel(f"latent dimension {dimensions[0] + 1}")
        bottom.set_xlabel("norm of sigma of each detection")
    above[0].set_ylabel(f"latent dimension {(*dimensions, 1)[1] + 1}")
    below[0].set_yticks(range(len(classes)), classes)
    below[0].set_ylim(len(classes) - 0.5, -0.5)
    _fit(above, [*flat.values()])
    if num_far:
        total = sum(belief.mean.shape[0] * belief.mean.shape[1] for belief in shown.values())
        label = f"{num_far} of {total} detections, far from most of their class"
        above[0].plot([], [], "x", color=SOFT, label=label)
        figure.legend(loc="outside upper center", frameon=False)
    return figure


def _beliefs(ax: Axes, belief: Belief, classes: Sequence[str], colours: Sequence[str]) -> int:
    """Draws `[C, S, 2]` beliefs; returns how many lie far from their class."""
    mean, std = np.asarray(belief.mean), np.asarray(belief.std)
    centre, spread = np.median(mean, axis=1), np.median(std, axis=1)
    is_far = _apart(mean, centre[:, None], spread[:, None]) > _FAR
    for together in _groups(centre, spread):
        for place, c in enumerate(together):
            dash = (place * _DASH, (_DASH, _DASH * (len(together) - 1)))
            line = "-" if len(together) == 1 else dash
            _ellipses(ax, mean[c, ~is_far[c]], std[c, ~is_far[c]], colours[c], line, _PLAIN)
            faint = max(_FAINT, _PLAIN * min(1.0, _FEW / max(is_far.sum(), 1)))
            _ellipses(ax, mean[c, is_far[c]], std[c, is_far[c]], colours[c], ":", faint)
            near, far = mean[c, ~is_far[c]], mean[c, is_far[c]]
            # Hollow and of another shape, so that classes in one place are all seen.
            style = {"facecolors": "none", "edgecolors": colours[c]}
            ax.scatter(*near.T, s=30, marker=class_marker(c), linewidths=1.0, **style)
            ax.scatter(*far.T, s=25, marker="x", c=colours[c], linewidths=1.0)
        _name(ax, together, centre, spread, classes)
    return int(is_far.sum())


def _ellipses(
    ax: Axes,
    mean: np.ndarray,
    std: np.ndarray,
    colour: str,
    line: str | tuple[float, tuple[float, float]],
    alpha: float,
) -> None:
    """Ellipses around `[S, 2]` means; of those that nobody can tell apart one is drawn."""
    if len(mean) == 0:
        return
    rounded = np.round(np.concatenate([mean, std], axis=-1), 3)
    distinct, number = np.unique(rounded, axis=0, return_counts=True)
    patches = [Ellipse((x, y), 2 * a, 2 * b) for x, y, a, b in distinct]
    style = {"facecolors": "none", "edgecolors": colour, "linestyles": [line]}
    # As opaque as all of them on top of each other.
    ax.add_collection(PatchCollection(patches, alpha=1 - (1 - alpha) ** number, **style))


def _norms(ax: Axes, norms: np.ndarray, colours: Sequence[str]) -> None:
    """Draws `[C, S]` norms of sigma, a row for each class."""
    for c, of_class in enumerate(norms):
        # Side by side across the row, so that equal ones are seen.
        heights = c + np.linspace(-0.25, 0.25, len(of_class))
        style = {"facecolors": "none", "edgecolors": colours[c], "linewidths": 0.8}
        ax.scatter(of_class, heights, s=14, marker=class_marker(c), **style)
    ax.grid(axis="x", alpha=0.3)


def _fit(axes: np.ndarray, beliefs: list[Belief]) -> None:
    """Limits the axes to a square around all ellipses, with room for the names of classes."""
    means, radii = [belief.mean for belief in beliefs], [belief.std for belief in beliefs]
    low = np.min(np.subtract(means, radii), axis=(0, 1, 2))
    high = np.max(np.add(means, radii), axis=(0, 1, 2))
    half = 0.68 * np.max(high - low)
    x, y = (low + high) / 2
    axes[0].set(xlim=(x - half, x + half), ylim=(y - half, y + half))
    for ax in axes:
        ax.set_aspect("equal", adjustable="box")


def _apart(mean: np.ndarray, centre: np.ndarray, spread: np.ndarray) -> np.ndarray:
    """Distance of `[..., 2]` means from a centre, in standard deviations."""
    return np.linalg.norm((mean - centre) / np.maximum(spread, 1e-6), axis=-1)


def _groups(centre: np.ndarray, spread: np.ndarray) -> list[list[int]]:
    """Classes with `[C, 2]` centres, those in one place together."""
    found, waiting = [], list(range(len(centre)))
    while waiting:
        first = waiting[0]
        apart = _apart(centre[waiting], centre[first], spread[first])
        found.append([c for c, distance in zip(waiting, apart, strict=True) if distance < _FAR])
        waiting = [c for c in waiting if c not in found[-1]]
    return found


def _name(
    ax: Axes,
    together: list[int],
    centre: np.ndarray,
    spread: np.ndarray,
    classes: Sequence[str],
) -> None:
    """Writes the names of classes in one place, `[C, 2]`, above their ellipses."""
    first = together[0]
    name = ax.annotate(
        _named([classes[c] for c in together]),
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


def _named(classes: Sequence[str]) -> str:
    """Names of classes below one another, or of many what they have in common."""
    if len(classes) <= _MANY_TOGETHER:
        return "\n".join(classes)
    first, *others = (label.split(" ") for label in classes)
    shared = [word for word in first if all(word in other for other in others)]
    return " ".join(shared) or f"{len(classes)} classes"
