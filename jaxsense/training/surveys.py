"""Stages that draw scenes and survey them: every robot looks at every PoI, before any training."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxsense import looks
from jaxsense.config import Config
from jaxsense.core.types import Key, pytree
from jaxsense.sim.arena import Arena
from jaxsense.sim.world import Scene, make_world
from jaxsense.vae.detectors import Looks

_SHARE_OF_EMPTY = 8  # one empty scene for so many to train detectors with; rays take time


@pytree
class Survey:
    """Looks by every robot at every PoI of S scenes.

    Attributes:
      classes: `[S, N]` int32 true classes.
      scenes: `[S]` scenes.
      windows: for each modality `[S, N, F]` inputs of its detector.
      distances: `[S, M, N]` expected distances of the PoIs, in metres.
    """

    classes: Int[Array, "S N"]
    scenes: Scene
    windows: tuple[Float[Array, "S N F"], ...]
    distances: Float[Array, "S M N"]

    def looks(self, modality: int) -> Looks:
        """All looks by one modality, scene after scene."""
        windows = self.windows[modality]
        # XLA would fold the reshape into sums over the looks, which then round otherwise.
        flat = jax.lax.optimization_barrier(windows.reshape(-1, windows.shape[-1]))
        return Looks(flat, self.distances[:, modality].reshape(-1))

    def of_scenes(self, part: slice) -> "Survey":
        """The survey of some of the scenes; `part` is static."""
        return jax.tree.map(lambda x: x[part], self)


@pytree
class Surveys:
    """Surveys of all scenes.

    Attributes:
      training: of the scenes to train detectors with.
      others: of those for the bank, to measure on, and empty ones, in this order.
    """

    training: Survey
    others: Survey


def num_scenes(config: Config) -> tuple[int, int, int, int]:
    """Numbers of scenes to train detectors with, for the bank, to measure on, and empty ones."""
    num_pois, num_classes = config.arena.num_pois, len(config.arena.classes)
    num_bank = -(-config.jmvae.samples_per_class * num_classes // num_pois)
    num_held_out = -(-held_out_per_class(config) * num_classes // num_pois)
    num_train = -(-config.detector.num_scans // num_pois)
    num_empty = -(-num_train // _SHARE_OF_EMPTY)
    num_for_starts = num_starts(config) * config.jmvae.num_together
    parts = num_train, max(num_bank, num_for_starts), num_held_out
    # Whole groups of scenes that show the same PoIs.
    together = config.jmvae.num_together
    num_train, num_bank, num_held_out = (-(-number // together) * together for number in parts)
    return num_train, num_bank, num_held_out, num_empty


def held_out_per_class(config: Config) -> int:
    """Number of held-out looks at each class."""
    return -(-config.detector.num_held_out // len(config.arena.classes))


def num_training(config: Config) -> int:
    """Looks by each sensor to train its detector with, in whole groups; the others calibrate it."""
    together, num_pois = config.jmvae.num_together, config.arena.num_pois
    if together == 1:
        return config.detector.num_training(num_scenes(config)[0] * num_pois)
    return together * num_pois * config.detector.num_training(num_scenes(config)[0] // together)


def num_starts(config: Config) -> int:
    """Number of surveyed scenes in which episodes start; 0 unless looks are live."""
    return config.dqn.num_starts if config.dqn.observe == "live" else 0


Scenes = tuple[Key, Int[Array, "S N"], Bool[Array, " S"], Key | None]
"""Keys, classes, which are empty, and keys of the PoIs' places, see `draw_scenes`."""


def draw_scenes(key: Key, config: Config) -> Scenes:
    """Draws keys and classes of all scenes.

    Returns:
      `[S]` keys of the scenes, `[S, N]` int32 classes of their PoIs, `[S]` bool, in which scenes
      no look shows its PoI, and `[S]` keys of the PoIs' places, of which four in a row are
      the same if the JMVAE learns from groups of looks; otherwise None.
    """
    class_key, scene_key = jax.random.split(key)
    numbers = num_scenes(config)
    keys = jax.random.split(class_key, len(numbers))
    total, each = sum(numbers), config.jmvae.num_together
    parts = [
        looks.balanced_classes(k, config, -(-n // each)) for k, n in zip(keys, numbers, strict=True)
    ]
    classes = jnp.repeat(jnp.concatenate(parts), each, axis=0)[:total]
    is_empty = jnp.arange(total) >= sum(numbers[:3])
    places = None
    if each > 1:
        scene_key, place_key = jax.random.split(scene_key)
        place_keys = jax.random.split(place_key, -(-total // each))
        places = jnp.repeat(place_keys, each)[:total]
    return jax.random.split(scene_key, total), classes, is_empty, places


def survey(key: Key, config: Config, *, arena: Arena, scenes: Scenes) -> Survey:
    """Surveys all scenes together: compiling takes longer than running.

    It may get a part of the scenes, and knows nothing of their number.
    """
    del key
    keys, classes, is_empty, places = scenes
    world = make_world(config, arena=arena)
    seen, windows, distances = looks.surveys(keys, world, classes, is_empty, places)
    return Survey(classes, seen, windows, distances)


def divide(config: Config, survey: Survey, **_: Scenes) -> Surveys:
    """Divides the survey of all scenes by what it is for."""
    number = num_scenes(config)[0]
    return Surveys(survey.of_scenes(slice(number)), survey.of_scenes(slice(number, None)))
