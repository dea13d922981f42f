"""Looks that all variants learn from, and how a network sees them."""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsense import PRESETS, Key, learn
from jaxsense.training import scans

TOGETHER = 8
"""Looks by each sensor at a PoI; variants learn from groups of 1, 2, 4 or all of them."""

Seen = tuple[Float[Array, "P K _"], ...]
"""For each sensor `[P, K, F_m]` numbers that a network sees of K looks at each of P PoIs."""


@dataclasses.dataclass(frozen=True)
class Looks:
    """Looks by each sensor at P PoIs.

    Attributes:
      windows: for each sensor `[P, 8, F_m]` linear RGB, or distances in metres.
      frames: for each sensor `[P, 8, G_m]` the same looks in its frame, see `vae.frames`.
      circumstances: `[P, 8, 7]` what says nothing of the class: from how far each sensor looks, in
        metres, and direction and strengths of the light.
      classes: `[P]` of the PoIs.
    """

    windows: Seen
    frames: Seen
    circumstances: Float[Array, "P 8 7"]
    classes: np.ndarray

    def part(self, rows: slice | np.ndarray) -> "Looks":
        """Some of the PoIs."""
        seen = [tuple(x[rows] for x in group) for group in (self.windows, self.frames)]
        return Looks(seen[0], seen[1], self.circumstances[rows], self.classes[rows])


View = Callable[[Looks], Seen]
"""How a network sees looks."""


def as_they_are(looks: Looks) -> Seen:
    """Windows in their units."""
    return looks.windows


def standardised(looks: Looks) -> Seen:
    """Windows without the mean of each number, over their overall standard deviation."""

    def of(x: jax.Array) -> jax.Array:
        centred = x - jnp.mean(x, axis=(0, 1), keepdims=True)
        return centred / (jnp.std(centred) + 1e-6)

    return tuple(map(of, looks.windows))


def in_frames(looks: Looks) -> Seen:
    """Looks in the frames of their sensors, which are standardised in the same way."""
    return looks.frames


def simulate(key: Key, number: int) -> Looks:
    """Looks of the preset `raw`, in random order of the PoIs.

    Args:
      key: random key.
      number: of scans by each sensor, at least.
    """
    raw = PRESETS["raw"]
    config = dataclasses.replace(
        raw,
        # No detector is calibrated, so all looks are to learn from.
        detector=dataclasses.replace(
            raw.detector, num_scans=number, num_held_out=1, calibration=0.0
        ),
        jmvae=dataclasses.replace(raw.jmvae, looks=TOGETHER, samples_per_class=1),
        dqn=dataclasses.replace(raw.dqn, observe="bank"),
    )
    survey_key, order_key = jax.random.split(key)

    @jax.jit
    def looks(key: Key) -> tuple[Seen, Seen, jax.Array, jax.Array]:
        outputs = learn(key, config, until="views").outputs
        surveys = outputs["survey"].training
        light = surveys.scenes.light
        shown = jnp.column_stack([light.direction, light.diffuse, light.ambient])
        each = jnp.broadcast_to(shown[:, None], (*surveys.classes.shape, shown.shape[1]))
        distances = jnp.swapaxes(surveys.distances, 1, 2)
        around = jnp.concatenate([distances, each], axis=-1)
        grouped = [scans.grouped(x, config) for x in (*surveys.windows, around)]
        classes = surveys.classes[::TOGETHER].reshape(-1)
        return tuple(grouped[:-1]), outputs["views"].groups, grouped[-1], classes

    windows, frames, around, classes = looks(survey_key)
    order = np.asarray(jax.random.permutation(order_key, len(classes)))
    return Looks(windows, frames, around, np.asarray(classes)).part(order)


def regrouped(seen: Seen, number: int) -> Seen:
    """Groups of K looks at the same PoI, from all groups of eight: the same scans for every K.

    Args:
      seen: `[P, 8, F_m]` of each sensor.
      number: K, which divides 8.
    """
    return tuple(x.reshape(-1, number, x.shape[-1]) for x in seen)
