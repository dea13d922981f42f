"""The colours of classes, robots and policies in plots and films."""

import itertools
import math

import numpy as np
from numpy.typing import ArrayLike

from jaxsense.config.scene import ArenaConfig

MARKERS = "oDs^vPX<>pdh"
SOFT = "#59616e"
"""Colour of what matters less."""

_ROBOTS = ("#8250c8", "#d9700a", "#0891a8", "#7d8a12")
# They differ also for those who see no red or no green.
_POLICIES = {
    "latent": "#1558b0",
    "bayes": "#00805f",
    "optimal": "#5e0d2b",
    "naive": "#523a05",
    "random": "#1711c8",
}
_APART = 0.25  # in RGB, which the eye distinguishes at a glance
_TOGETHER = 0.05  # latent distance of classes that a picture cannot separate


def modality_colour(modality: int) -> str:
    """The colour of the robots that carry a sensor, by its index."""
    return _ROBOTS[modality % len(_ROBOTS)]


def policy_colour(name: str) -> str:
    """Colour of a policy in all plots; soft for most."""
    return _POLICIES.get(name, SOFT)


def class_colour(arena: ArenaConfig, label: str) -> str:
    """The colour of a class as `#rrggbb`, unique in the arena.

    It is the colour of the PoIs. If an earlier class has it, it is a darker or lighter shade: half
    way to black or to white or, if those are taken too, the one that differs most from all others.
    """
    classes, taken = arena.classes, list[np.ndarray]()
    # More than classes, also for black or white, which cannot be darker or lighter.
    tones = (0.0, -0.5, 0.5, *np.linspace(-0.75, 0.6, 4 * len(classes)))

    def distance(shade: np.ndarray) -> float:
        return min([_APART, *(math.dist(shade, other) for other in taken)])

    for each in classes[: classes.index(label) + 1]:
        paint = np.array(arena.colours[each.split(" ")[0]])
        shades = [paint + abs(tone) * ((tone > 0) - paint) for tone in tones]
        taken.append(max(shades, key=distance))
    return "#" + "".join(f"{round(255 * float(part)):02x}" for part in taken[-1])


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
    """`[..., D]` as `[..., 2]`: the one or two latent dimensions of `plane`, or zero."""
    values = np.asarray(values)[..., shown]
    return np.pad(values, [(0, 0)] * (values.ndim - 1) + [(0, 1)])[..., :2]
