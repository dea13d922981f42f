"""Stages that survey scenes, train the detectors, and detect what all later stages learn from.

In a survey every robot looks at every PoI of a scene; all scenes are surveyed before any training.
"""

import dataclasses
import itertools
from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxsense import looks
from jaxsense.config import Config
from jaxsense.core import novelty
from jaxsense.core.networks import Params
from jaxsense.core.novelty import Novelty
from jaxsense.core.supervised import FitState, Problem
from jaxsense.core.types import Key, Samples, pytree
from jaxsense.models import make_bayes, make_detector
from jaxsense.sim import sensors
from jaxsense.sim.sensors import Sensor
from jaxsense.sim.world import make_world
from jaxsense.training.stage import Fit, Output, Stage, fit_stage
from jaxsense.vae import detectors
from jaxsense.vae.detectors import Classifier, Detector, Looks

T = TypeVar("T")

_SHARE_OF_EMPTY = 8  # one empty scene for so many to train detectors with; rays take time
_NUM_CHECKS = 8192  # the most looks of each kind that set a threshold
_SPOILT_EACH = 512  # windows of each kind that are spoilt by hand
_REPEATS = 4  # looks in a scene
_ELSEWHERE = 0.5, 2.0  # of the distance, outside of which a PoI is not where it is expected


@pytree
class Survey:
    """Looks by every robot at every PoI of S scenes.

    Attributes:
      classes: `[S, N]` int32 true classes.
      windows: for each modality `[S, N, F]` inputs of its detector.
      distances: `[S, M, N]` expected distances of the PoIs, in metres.
    """

    classes: Int[Array, "S N"]
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
    """Surveys of all scenes, by what they are for.

    Attributes:
      training: to train detectors with.
      bank: to learn from what trained detectors say.
      held_out: to measure on.
      empty: whose PoIs no look shows.
    """

    training: Survey
    bank: Survey
    held_out: Survey
    empty: Survey


def num_scenes(config: Config) -> tuple[int, int, int, int]:
    """Numbers of scenes to train detectors with, for the bank, to measure on, and empty ones."""
    together, num_pois = config.jmvae.num_together, config.arena.num_pois
    num_train = -(-config.detector.num_scans // num_pois)
    num_bank, num_held_out = (
        -(-each * len(config.arena.classes) // num_pois)
        for each in (config.jmvae.samples_per_class, held_out_per_class(config))
    )
    parts = num_train, num_bank, num_held_out
    # Whole groups of scenes that show the same PoIs.
    training, bank, held_out = (-(-number // together) * together for number in parts)
    return training, bank, held_out, -(-num_train // _SHARE_OF_EMPTY)


def held_out_per_class(config: Config) -> int:
    """Number of held-out looks at each class."""
    return -(-config.detector.num_held_out // len(config.arena.classes))


def num_training(config: Config) -> int:
    """Looks by each sensor to train its detector with, in whole groups; the others calibrate it."""
    together, num_pois = config.jmvae.num_together, config.arena.num_pois
    group = 1 if together == 1 else together * num_pois
    return group * config.detector.num_training(num_scenes(config)[0] * num_pois // group)


Scenes = tuple[Key, Int[Array, "S N"], Bool[Array, " S"], Key | None]
"""Keys, classes, which are empty, and keys of the PoIs' places, see `draw_scenes`."""


def draw_scenes(key: Key, config: Config) -> Scenes:
    """Draws keys and classes of all scenes.

    Returns:
      `[S]` keys of the scenes, classes of their PoIs, in which scenes no look shows its PoI, and
      `[S]` keys of the PoIs' places, of which four in a row are the same if the JMVAE learns from
      groups of looks; otherwise None.
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


def survey(key: Key, config: Config, *, scenes: Scenes) -> Survey:
    """Surveys all scenes together: compiling takes longer than running.

    It may get a part of the scenes, and knows nothing of their number.
    """
    del key
    keys, classes, is_empty, places = scenes
    return Survey(classes, *looks.surveys(keys, make_world(config), classes, is_empty, places))


def divide(config: Config, survey: Survey, **_: Scenes) -> Surveys:
    """Divides the survey of all scenes by what it is for."""
    ends = itertools.accumulate(num_scenes(config), initial=0)
    return Surveys(*(survey.of_scenes(slice(*part)) for part in itertools.pairwise(ends)))


@pytree
class Shown:
    """Classes that all looks at a PoI show together, of scenes that the JMVAE did not learn from.

    Attributes:
      calibrating: `[S, N]` int32 of the training scenes that calibrate the encoders.
      bank: `[S', N]` int32 of the scenes of the bank.
    """

    calibrating: Int[Array, "S N"]
    bank: Int[Array, "S' N"]


@pytree
class Detections:
    """Features of surveys that no detector was trained on.

    Attributes:
      bank: for each modality `[C, S, D_m]` features for training.
      held_out: for each modality `[C, S', D_m]` features of other scenes, to measure on.
      windows: for each modality `[C, 1, F]` one held-out look at each class.
      by_distance: the bank for robots that travel, if they do.
    """

    bank: Samples
    held_out: Samples
    windows: tuple[Float[Array, "C 1 F"], ...]
    by_distance: looks.Bank | None


def looks_at_nothing(key: Key, config: Config, *, surveys: Surveys) -> tuple[Looks, ...]:
    """Looks that show no PoI, for each modality in random order.

    Empty ones, and looks at PoIs that are spoilt by hand: most of their readings are lost, all are
    equal, or the PoI is expected at another distance.
    """
    limits = config.viewpoint

    def of_modality(key: Key, m: int, sensor: Sensor) -> Looks:
        keys = jax.random.split(key, 5)
        lost_key, share_key, level_key, distance_key, order_key = keys
        shown, _ = _divided(surveys.training.looks(m), _SPOILT_EACH)
        windows, distances = shown.windows, shown.distances
        number = windows.shape[:1]
        blind = jnp.minimum(sensor.blind, sensor.window_limit)
        share = jax.random.uniform(share_key, (*number, 1), minval=0.6)
        lost = jax.random.uniform(lost_key, windows.shape) < share
        levels = jax.random.uniform(level_key, (*number, 1)) * jnp.max(windows)
        is_zero, is_blind = (jnp.arange(number[0])[:, None] % 4 == i for i in (0, 1))
        levels = jnp.where(is_zero, 0.0, jnp.where(is_blind, blind, levels))
        near, far = limits.min_distance, limits.max_distance
        expected = jax.random.uniform(distance_key, number, minval=near, maxval=far)
        ratio = expected / distances
        is_elsewhere = (ratio < _ELSEWHERE[0]) | (ratio > _ELSEWHERE[1])
        parts = [
            surveys.empty.looks(m),
            Looks(jnp.where(lost, blind, windows), distances),
            Looks(jnp.broadcast_to(levels, windows.shape), distances),
            # Where it is expected about right, an empty window instead.
            Looks(jnp.where(is_elsewhere[:, None], windows, blind), expected),
        ]
        together = jax.tree.map(lambda *x: jnp.concatenate(x), *parts)
        order = jax.random.permutation(order_key, len(together.windows))
        return jax.tree.map(lambda x: x[order], together)

    keys, made = jax.random.split(key, len(config.modalities)), sensors.make(config)
    return tuple(of_modality(keys[m], m, sensor) for m, sensor in enumerate(made))


def detector_stage(
    modality: int,
    config: Config,
    finish: Callable[..., Detector] = lambda config, classifier, **inputs: classifier,
) -> Stage:
    """Makes the stage that trains the detector of one modality, by its index.

    If the JMVAE learns from scans, it knows a single label: that a PoI is there.

    Args:
      finish: `(config, classifier, **inputs) -> detector`, after the training.
    """
    number, reads_scans = num_training(config), config.jmvae.reads_scans
    of_class = config.label_of_class(config.modalities[modality])

    def fit(
        config: Config, *, surveys: Surveys, examples: tuple[Looks, ...], **given: Output
    ) -> Fit:
        classes = surveys.training.classes.reshape(-1)
        labels = jnp.zeros_like(classes) if reads_scans else jnp.array(of_class)[classes]
        to_train, held_out = _divided((surveys.training.looks(modality), labels), number)
        nothing = examples[modality]
        few_of_nothing, nothing = _divided(nothing, min(len(nothing.distances) // 4, _NUM_CHECKS))

        def untrained(key: Key) -> tuple[Classifier, Params]:
            detector = make_detector(key, config, modality, to_train[0].windows)
            return detector, detector.params

        def problem(detector: Classifier) -> Problem[Output]:
            return detectors.problem(config.detector, detector, *to_train, nothing)

        def trained(detector: Classifier, fit: FitState) -> Detector:
            found = dataclasses.replace(detector, params=fit.params)
            if len(held_out[1]) and not reads_scans:
                found = detectors.calibrate(found, *held_out)
            checks, _ = _divided(surveys.bank.looks(modality), _NUM_CHECKS)
            found = detectors.fitted(found, checks, few_of_nothing)
            return finish(config, found, surveys=surveys, **given)

        return Fit(untrained, problem, trained)

    return fit_stage(f"detector_{config.modalities[modality]}", config.detector.steps, fit)


def _divided(rows: T, number: int) -> tuple[T, T]:
    """The first rows, and the rest."""
    return jax.tree.map(lambda x: x[:number], rows), jax.tree.map(lambda x: x[number:], rows)


def detect(
    key: Key,
    config: Config,
    *,
    surveys: Surveys,
    trained: tuple[Detector, ...],
    shown: Shown | None = None,
) -> Detections:
    """Applies the detectors to the surveys that they were not trained on.

    Looks for training are sorted by their true classes, or by those that all looks at a PoI show.
    """
    del key
    bank, held_out = surveys.bank, surveys.held_out

    def features(survey: Survey) -> tuple[jax.Array, ...]:
        return looks.features(trained, survey.windows, survey.distances)

    def by_class(values: tuple[jax.Array, ...], classes: jax.Array, number: int) -> Samples:
        num_classes = len(config.arena.classes)
        return tuple(looks.by_class(x, classes, num_classes, number) for x in values)

    classes = bank.classes if shown is None else shown.bank
    given = features(bank), tuple(jnp.swapaxes(bank.distances, 0, 1))
    found = [by_class(x, classes, config.jmvae.samples_per_class) for x in given]
    return Detections(
        bank=found[0],
        by_distance=looks.by_distance(*found) if config.dqn.task == "team" else None,
        held_out=by_class(features(held_out), held_out.classes, held_out_per_class(config)),
        windows=by_class(held_out.windows, held_out.classes, 1),
    )


def learn_novelty(
    key: Key,
    config: Config,
    *,
    trained: tuple[Detector, ...],
    scenes: Scenes,
    shown: Shown | None = None,
) -> Novelty:
    """Learns how much of a look is new, see `core.novelty`; without repeated looks, all of it."""
    number = config.detector.num_repeats
    if not number:
        return novelty.independent(len(trained))
    world, exact = make_world(config), make_bayes(config)
    class_key, *keys = jax.random.split(key, 1 + len(trained))
    classes, places, taken_for = repeated(class_key, config, scenes, shown)

    def fit(m: int) -> tuple[jax.Array, jax.Array]:
        scene_keys = jax.random.split(keys[m], number)
        *seen, positions = looks.repeats(scene_keys, world, classes, m, _REPEATS, places)

        def read(*look: jax.Array) -> jax.Array:
            return exact.log_likelihoods(detectors.features(trained[m], *look), m)

        return novelty.fit(jax.vmap(jax.vmap(read))(*seen), positions, taken_for)

    strength, length = zip(*map(fit, range(len(trained))), strict=True)
    return Novelty(jnp.stack(strength), jnp.stack(length))


def repeated(
    key: Key, config: Config, scenes: Scenes, shown: Shown | None
) -> tuple[Int[Array, "S N"], Key | None, Int[Array, " S"]]:
    """Scenes at whose first PoIs each sensor looks again and again.

    With what all looks at PoIs show, those of the bank, in another light.

    Returns:
      Classes of the PoIs, keys of their places if they are given, and the classes that the first
      PoIs are taken for.
    """
    number = config.detector.num_repeats
    if shown is None:
        shape = number, config.arena.num_pois
        classes = jax.random.randint(key, shape, 0, len(config.arena.classes))
        return classes, None, classes[:, 0]
    _, classes, _, places = scenes
    assert places is not None
    # One scene of each group; from the first again if there are fewer.
    rows = jnp.arange(number) * config.jmvae.num_together % len(shown.bank)
    of_bank = num_scenes(config)[0] + rows
    return classes[of_bank], places[of_bank], shown.bank[rows, 0]
