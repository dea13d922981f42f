"""The colours of classes and robots in plots and animations."""

import itertools
import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from jaxsense.config import ArenaConfig

RGB = tuple[float, float, float]
MARKERS = "oDs^vPX<>pdh"
SOFT = "#59616e"
"""Colour of what matters less."""

_ROBOT_COLOURS = ("#8250c8", "#d9700a", "#0891a8", "#7d8a12")
_POLICY_COLOURS = {
    "latent": ("#1558b0", "#2a7cc6"), "greedy": ("#b84300", "#bd5f21"),
    "bayes": ("#00805f", "#2c8c71"), "optimal": ("#5e0d2b", "#f05983"),
    "nearest": ("#cd79aa", "#cc69a4"), "auction": ("#d00dd4", "#d93fff"),
    "rollout": ("#b79710", "#b7960a"), "naive": ("#523a05", "#917b4f"),
    "naive_2": ("#05475b", "#47def1"), "naive_3": ("#d00e4d", "#ff8bb5"),
    "random": ("#1711c8", "#af9aff"), "network": ("#0c0054", "#f0d800"),
}  # fmt: skip
_OTHER_POLICY = ("#0fb851", "#0cc75f"), "*"  # a custom one
ON_DARK = dict([*_POLICY_COLOURS.values(), _OTHER_POLICY[0]])
"""Counterparts of the colours of policies on a dark page, where they must differ as well."""
_APART = 0.25  # in RGB, which the eye distinguishes at a glance
_TOGETHER = 0.05  # latent distance of classes that a picture cannot separate
_DARKEST, _LIGHTEST = -0.75, 0.6


def modality_colour(modality: int) -> str:
    """The colour of the robots that carry a sensor, by its index."""
    return _ROBOT_COLOURS[modality % len(_ROBOT_COLOURS)]


def policy_colour(name: str) -> str:
    """The colour of a policy, the same in all plots.

    Colours differ also for those who see no red or no green, and so do those of `ON_DARK`.
    """
    return _POLICY_COLOURS.get(name, _OTHER_POLICY[0])[0]


def policy_marker(name: str) -> str:
    """The marker of a policy, the same in all plots."""
    markers = dict(zip(_POLICY_COLOURS, MARKERS, strict=True))
    return markers.get(name, _OTHER_POLICY[1])


def series(number: int) -> dict[str, Any]:
    """The colour and marker of a curve that belongs to no policy, sensor or class, by its number.

    They are those of policies, one after another, since they differ for everybody.
    """
    return {
        "color": [*_POLICY_COLOURS.values()][number % len(_POLICY_COLOURS)][0],
        "marker": MARKERS[number % len(MARKERS)],
    }


def class_marker(index: int) -> str:
    """The marker of a class, by its place in `arena.classes`."""
    return MARKERS[index % len(MARKERS)]


def class_colour(arena: ArenaConfig, label: str) -> RGB:
    """The colour of a class, RGB in [0, 1], unique in the arena.

    It is the colour of the PoIs or, if an earlier class has it, a shade: half as bright, half way
    to white or, if those are taken too, the shade that differs most from all others.

    Args:
      arena: with the colours.
      label: of the class.
    """
    classes, taken = arena.classes, []
    for each in classes[: classes.index(label) + 1]:
        # More than classes, also for black or white, which cannot be darker or lighter.
        tones = (0.0, -0.5, 0.5, *np.linspace(_DARKEST, _LIGHTEST, 4 * len(classes)).tolist())
        shades = [_shade(arena.colours[each.split(" ")[0]], tone) for tone in tones]
        taken.append(max(shades, key=lambda shade: _distance(shade, taken)))
    return taken[-1]


def _shade(colour: RGB, tone: float) -> RGB:
    """A colour, darker (tone < 0) or lighter (tone > 0), up to black at -1 and white at 1."""
    red, green, blue = (part + abs(tone) * ((tone > 0) - part) for part in colour)
    return red, green, blue


def _distance(colour: RGB, others: list[RGB]) -> float:
    """Distance of a colour from the nearest of others, at most `_APART`."""
    return min([_APART, *(math.dist(colour, other) for other in others)])


def as_hex(colour: RGB) -> str:
    """RGB in [0, 1] as `#rrggbb`."""
    return "#" + "".join(f"{round(255 * part):02x}" for part in colour)


def as_srgb(linear: np.ndarray) -> np.ndarray:
    """Linear RGB in [0, 1] as sRGB (IEC 61966-2-1)."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def plane(means: np.ndarray) -> list[int]:
    """The two latent dimensions that show `[C, D]` classes farthest apart; the only one if D is 1.

    Distances count by their logarithms, so that all pairs of classes matter.
    """
    apart = means[:, None] - means[None]

    def distance(shown: tuple[int, ...]) -> float:
        return float(np.mean(np.log(np.linalg.norm(apart[..., shown], axis=-1) + _TOGETHER)))

    number = means.shape[1]
    return list(max(itertools.combinations(range(number), min(number, 2)), key=distance))


def in_plane(values: ArrayLike, shown: list[int]) -> np.ndarray:
    """`[..., D]` as `[..., 2]`: the latent dimensions of `plane`, or zero.

    Args:
      values: `[..., D]`.
      shown: one or two dimensions.
    """
    values = np.asarray(values)[..., shown]
    return np.pad(values, [(0, 0)] * (values.ndim - 1) + [(0, 1)])[..., :2]
