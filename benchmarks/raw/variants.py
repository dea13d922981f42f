"""The ways of training that are compared: the paper's, ours, and what lies between them."""

import dataclasses

import numpy as np

from benchmarks.raw.looks import View, as_they_are, in_frames, standardised
from jaxsense import PRESETS
from jaxsense.config import JmvaeConfig

RATIOS = ((1, 16), (1, 4), (1, 1), (2, 1), (4, 1), (8, 1), (16, 1))
"""Numbers of the camera's window over those of the LiDAR's."""
DEPTHS = (1, 2, 4, 8)
"""Hidden layers of every network."""
_PER_STEP = 512  # looks by each sensor, whatever K


@dataclasses.dataclass(frozen=True)
class Variant:
    """One way of training.

    Attributes:
      name: in the tables.
      jmvae: weights, schedules, learning rate, steps, and sizes of the networks.
      looks: K by each sensor at a PoI.
      leaves_out: whether each look is decoded from all others, or from all.
      view: how networks see looks.
      learns_variance: whether each sensor's variance is that of its errors, or 1.
      is_mean: whether squared errors are averaged over the F_m numbers of a look, or added up.
      alpha_ramp: share of the training over which alpha rises; at first, posteriors of fewer looks
        follow that of all and do not draw it. With 0, they draw it as soon as alpha sets in.
      pairs: whether sets of one look by each sensor are drawn to the posterior of all.
      private: latents that each look has for itself.
      repeats: how often the longer of the windows is repeated for each sensor, see `rows`; each is
        as long as it is by default.
    """

    name: str
    jmvae: JmvaeConfig
    looks: int
    leaves_out: bool
    view: View
    learns_variance: bool
    is_mean: bool
    alpha_ramp: float
    pairs: bool
    private: int = 0
    repeats: tuple[int, ...] | None = None

    def but(self, name: str, **changes: object) -> "Variant":
        """Another variant, which differs in some attributes or settings of the JMVAE.

        Args:
          name: of the variant.
          changes: by name of the attribute or setting.
        """
        settings = {field.name for field in dataclasses.fields(JmvaeConfig)} - {"looks"}
        of_jmvae = {name: value for name, value in changes.items() if name in settings}
        others = {name: value for name, value in changes.items() if name not in settings}
        jmvae = dataclasses.replace(self.jmvae, **of_jmvae)
        return dataclasses.replace(self, name=name, jmvae=jmvae, **others)

    @property
    def batch(self) -> int:
        """PoIs in a gradient step, so that all variants see as many looks in each."""
        return max(_PER_STEP // self.looks, 1)

    def rows(self, sizes: tuple[int, ...]) -> tuple[np.ndarray, ...]:
        """Which of a look's F_m numbers a network sees, for each sensor `[F'_m]` indices.

        With `repeats`, a sensor's numbers are repeated, in turn, as often as it takes to be r_m
        times as many as those of the sensor that has most. So 1:1 means equally many numbers.

        Args:
          sizes: F_m of each sensor.
        """
        if self.repeats is None:
            return tuple(map(np.arange, sizes))
        whole = [times * max(sizes) for times in self.repeats]
        return tuple(np.arange(w) * size // w for w, size in zip(whole, sizes, strict=True))


OURS = Variant(
    "ours",
    PRESETS["raw"].jmvae,
    looks=PRESETS["raw"].jmvae.looks,
    leaves_out=True,
    view=in_frames,
    learns_variance=True,
    is_mean=True,
    alpha_ramp=0.2,
    pairs=True,
)
PAPER = Variant(
    "paper",
    dataclasses.replace(
        PRESETS["paper"].jmvae,
        hidden=OURS.jmvae.hidden,
        steps=OURS.jmvae.steps,
        annealing=0.0,
        reconstruction_weights=(1.0, 1.0),
    ),
    looks=1,
    leaves_out=False,
    view=as_they_are,
    learns_variance=False,
    is_mean=False,
    alpha_ramp=0.0,
    pairs=False,
)
_STANDARDISED = PAPER.but("paper, standardised", view=standardised)
_SUMMED = {
    "learns_variance": False, "is_mean": False, "reconstruction_weights": (1.0, 1.0)
}  # fmt: skip
# Divergences from the prior weigh as much whether looks are decoded from one posterior or three.
_OF_ONE = {"beta": 3 * OURS.jmvae.beta, "initial_beta": 3 * OURS.jmvae.initial_beta}
_OF_THREE = {"beta": PAPER.jmvae.beta / 3}  # constant

ABLATION = (
    PAPER,
    _STANDARDISED,
    _STANDARDISED.but("paper, standardised, mean of squares", is_mean=True),
    _STANDARDISED.but(
        "paper, our weighting", learns_variance=True, is_mean=True,
        reconstruction_weights=OURS.jmvae.reconstruction_weights,
    ),
    PAPER.but("paper, our frames", view=in_frames),
    PAPER.but("paper, six private latents", private=6),
    PAPER.but("paper, four looks", looks=OURS.looks),
    PAPER.but("paper, four looks, leave-one-out", looks=OURS.looks, leaves_out=True,
              **_OF_THREE),
    PAPER.but("paper, our frames, four looks", view=in_frames, looks=OURS.looks),
    PAPER.but("paper, our frames, four looks, leave-one-out", view=in_frames, looks=OURS.looks,
              leaves_out=True, **_OF_THREE),
    OURS.but("ours, one look by each sensor", looks=1, leaves_out=False, pairs=False, **_OF_ONE),
    OURS.but("ours, decoded from all looks", leaves_out=False, **_OF_ONE),
    OURS.but("ours, two looks", looks=2),
    OURS.but("ours, eight looks", looks=8),
    OURS.but("ours, windows as they are", view=as_they_are),
    OURS.but("ours, windows standardised", view=standardised),
    OURS.but("ours, windows standardised, decoded from all looks", view=standardised,
             leaves_out=False, **_OF_ONE),
    OURS.but("ours, variance 1", learns_variance=False),
    OURS.but("ours, sum of squares, variance 1", **_SUMMED),
    OURS.but("ours, sum of squares, variance learned", is_mean=False,
             reconstruction_weights=(1.0, 1.0)),
    OURS.but("ours, weights 6 and 6", reconstruction_weights=(6.0, 6.0)),
    OURS.but("ours, weights 60 and 60", reconstruction_weights=(60.0, 60.0)),
    OURS.but("ours, weights 1000 and 1000", reconstruction_weights=(1000.0, 1000.0)),
    OURS.but("ours, six private latents", private=6),
    OURS.but("ours, no pairs", pairs=False),
    OURS.but("ours, alpha from the start", alpha_start=0.0, alpha_ramp=0.0),
    OURS.but("ours, beta constant", annealing=0.0),
    OURS,
)  # fmt: skip
"""From the paper's way to ours: either with one thing changed, or with a few that may need each
other."""

DRAWN = (PAPER.name, OURS.name)
"""Variants of the ablation whose posteriors are kept, to be drawn."""

OF_RATIO = {
    "paper, standardised": _STANDARDISED,
    "ours, sum of squares": OURS.but("", **_SUMMED),
    "ours": OURS,
}
"""The ways of training whose windows are repeated."""

OF_DEPTH = {"paper": PAPER, "paper, standardised": _STANDARDISED, "ours": OURS}
"""The ways of training whose networks get deeper."""

TABLES: dict[str, tuple[Variant, ...]] = {
    "ablation": ABLATION,
    "ratio": tuple(
        given.but(f"{name}, {camera}:{lidar}", repeats=(camera, lidar))
        for name, given in OF_RATIO.items()
        for camera, lidar in RATIOS
    ),
    "depth": tuple(
        given.but(f"{name}, depth {depth}", hidden=(OURS.jmvae.hidden[0],) * depth)
        for name, given in OF_DEPTH.items()
        for depth in DEPTHS
    ),
}
"""The variants of each table."""
