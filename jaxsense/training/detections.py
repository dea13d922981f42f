"""Stages that train the detectors, and what all later stages learn from.

Those are detections, and how much of a repeated look is new.
"""

import dataclasses
from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxsense import looks
from jaxsense.config import Config
from jaxsense.core.networks import Params
from jaxsense.core.supervised import FitState, Problem
from jaxsense.core.types import Key, Samples, pytree
from jaxsense.models import make_bayes, make_detector
from jaxsense.sim import sensors
from jaxsense.sim.arena import Arena
from jaxsense.sim.sensors import Sensor
from jaxsense.sim.world import Scene, make_world
from jaxsense.training.stage import Fit, Output, Stage, fit_stage
from jaxsense.training.surveys import (
    Scenes,
    Surveys,
    held_out_per_class,
    num_scenes,
    num_starts,
    num_training,
)
from jaxsense.vae import detectors, novelty
from jaxsense.vae.detectors import Classifier, Detector, Looks
from jaxsense.vae.novelty import Novelty

T = TypeVar("T")

_NUM_CHECKS = 8192  # the most looks of each kind that set a threshold
_SPOILT_EACH = 512  # windows of each kind that are spoilt by hand
_REPEATS = 4  # looks in a scene
_ELSEWHERE = 0.5, 2.0  # of the distance, outside of which a PoI is not where it is expected


@pytree
class Starts:
    """First scenes of episodes, and looks at their PoIs.

    Attributes:
      classes: `[S, N]` int32 true classes.
      scenes: `[S]` scenes.
      features: for each modality `[S, N, D_m]`.
    """

    classes: Int[Array, "S N"]
    scenes: Scene
    features: tuple[Float[Array, "S N D_m"], ...]


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
      starts: where episodes start; empty unless looks are live.
      windows: for each modality `[C, 1, F]` one held-out look at each class.
    """

    bank: Samples
    held_out: Samples
    starts: Starts
    windows: tuple[Float[Array, "C 1 F"], ...]


def looks_at_nothing(key: Key, config: Config, *, surveys: Surveys) -> tuple[Looks, ...]:
    """Looks that show no PoI, for each modality in random order.

    Empty ones, and looks at PoIs that are spoilt by hand: most of their readings are lost, all are
    equal, or the PoI is expected at another distance.
    """
    *_, num_empty = num_scenes(config)
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
            surveys.others.of_scenes(slice(-num_empty, None)).looks(m),
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
            bank = surveys.others.of_scenes(slice(num_scenes(config)[1])).looks(modality)
            found = detectors.fitted(found, _divided(bank, _NUM_CHECKS)[0], few_of_nothing)
            return finish(config, found, surveys=surveys, **given)

        return Fit(untrained, problem, trained)

    return fit_stage(f"detector_{config.modalities[modality]}", config.detector, fit)


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
    _, num_bank, _, num_empty = num_scenes(config)
    others = surveys.others.of_scenes(slice(-num_empty))
    features = looks.features(trained, others.windows, others.distances)

    def by_class(
        values: tuple[jax.Array, ...], part: slice, classes: jax.Array, number: int
    ) -> Samples:
        num_classes = len(config.arena.classes)
        return tuple(looks.by_class(x[part], classes, num_classes, number) for x in values)

    for_bank, for_measuring = slice(None, num_bank), slice(num_bank, None)
    of_bank = others.classes[for_bank] if shown is None else shown.bank
    of_measuring = others.classes[for_measuring]
    starts = Starts(others.classes, others.scenes, features)
    # One scene of each group: no two starts show the same PoIs.
    together = config.jmvae.num_together
    rows = slice(0, num_starts(config) * together, together)
    return Detections(
        bank=by_class(features, for_bank, of_bank, config.jmvae.samples_per_class),
        held_out=by_class(features, for_measuring, of_measuring, held_out_per_class(config)),
        starts=jax.tree.map(lambda x: x[rows], starts),
        windows=by_class(others.windows, for_measuring, of_measuring, 1),
    )


def learn_novelty(
    key: Key,
    config: Config,
    *,
    arena: Arena,
    trained: tuple[Detector, ...],
    scenes: Scenes | None = None,
    shown: Shown | None = None,
) -> Novelty:
    """Learns how much of a look is new, see `vae.Novelty`; without repeated looks, all of it."""
    number = config.detector.num_repeats
    if not number:
        return novelty.independent(len(trained))
    world, exact = make_world(config, arena=arena), make_bayes(config)
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
    key: Key, config: Config, scenes: Scenes | None, shown: Shown | None
) -> tuple[Int[Array, "S N"], Key | None, Int[Array, " S"]]:
    """Scenes at whose first PoIs each sensor looks again and again.

    With what all looks at PoIs show, those of the bank, in another light.

    Returns:
      Classes of the PoIs, keys of their places if they are given, and the classes that the first
      PoIs are taken for.
    """
    number = config.detector.num_repeats
    if scenes is None or shown is None:
        shape = number, config.arena.num_pois
        classes = jax.random.randint(key, shape, 0, len(config.arena.classes))
        return classes, None, classes[:, 0]
    _, classes, _, places = scenes
    assert places is not None
    # One scene of each group; from the first again if there are fewer.
    rows = jnp.arange(number) * config.jmvae.num_together % len(shown.bank)
    of_bank = num_scenes(config)[0] + rows
    return classes[of_bank], places[of_bank], shown.bank[rows, 0]
