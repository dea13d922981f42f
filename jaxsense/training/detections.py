"""Stages that train the detectors, and the detections that all later stages learn from."""

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxsense import looks
from jaxsense.config import Config
from jaxsense.core.networks import Params
from jaxsense.core.supervised import FitState
from jaxsense.core.types import Key, Samples, pytree
from jaxsense.models import make_detector
from jaxsense.sim import sensors
from jaxsense.sim.sensors import Sensor
from jaxsense.sim.world import Scene
from jaxsense.training.stage import Stage, fit_stage
from jaxsense.training.surveys import Surveys, held_out_per_class, num_scenes, num_starts
from jaxsense.vae import detectors
from jaxsense.vae.detectors import Classifier, Detector, Looks

_NUM_CHECKS = 8192  # the most looks of each kind that set a threshold
_SPOILT_EACH = 512  # windows of each kind that are spoilt by hand
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
        shown = jax.tree.map(lambda x: x[:_SPOILT_EACH], surveys.training.looks(m))
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


def fitting(
    config: Config, detector: Classifier, shown: Looks, labels: Int[Array, " S"], nothing: Looks
) -> detectors.Fitting:
    """Problem of fitting a detector, without the looks that `fitted` uses."""
    rest = jax.tree.map(lambda x: x[_num_checks(nothing) :], nothing)
    return detectors.Fitting(config.detector, detector, shown, labels, rest)


def fitted(
    config: Config, detector: Classifier, surveys: Surveys, modality: int, nothing: Looks
) -> Classifier:
    """Sets the threshold and the odds of a trained detector, with looks of the bank."""
    num_bank = num_scenes(config)[1]
    shown = surveys.others.of_scenes(slice(num_bank)).looks(modality)
    checks = jax.tree.map(lambda x: x[:_NUM_CHECKS], shown)
    return detectors.fitted(
        detector, checks, jax.tree.map(lambda x: x[: _num_checks(nothing)], nothing)
    )


def _num_checks(nothing: Looks) -> int:
    """Number of looks at nothing that set the threshold; the others train the detector."""
    return min(len(nothing.distances) // 4, _NUM_CHECKS)


def detector_stage(modality: int, config: Config) -> Stage:
    """Makes the stage that trains the detector of one modality, by its index."""

    def labelled(config: Config, surveys: Surveys) -> tuple[Looks, jax.Array, int]:
        """Looks at PoIs, their labels, and how many to train with; the others calibrate."""
        labels = jnp.array(config.label_of_class(config.modalities[modality]))
        of_looks = labels[surveys.training.classes.reshape(-1)]
        return (
            surveys.training.looks(modality),
            of_looks,
            config.detector.num_training(len(of_looks)),
        )

    def untrained(
        key: Key, config: Config, *, surveys: Surveys, examples: tuple[Looks, ...]
    ) -> tuple[Classifier, Params]:
        del examples
        shown, _, number = labelled(config, surveys)
        detector = make_detector(key, config, modality, shown.windows[:number])
        return detector, detector.params

    def problem(
        config: Config, detector: Classifier, *, surveys: Surveys, examples: tuple[Looks, ...]
    ) -> detectors.Fitting:
        shown, labels, number = labelled(config, surveys)
        first = jax.tree.map(lambda x: x[:number], shown)
        return fitting(config, detector, first, labels[:number], examples[modality])

    def trained(
        config: Config,
        detector: Classifier,
        fit: FitState,
        *,
        surveys: Surveys,
        examples: tuple[Looks, ...],
    ) -> Classifier:
        found = dataclasses.replace(detector, params=fit.params)
        shown, labels, number = labelled(config, surveys)
        others = jax.tree.map(lambda x: x[number:], shown)
        if number < len(labels):
            found = detectors.calibrate(found, others, labels[number:])
        return fitted(config, found, surveys, modality, examples[modality])

    return fit_stage(
        f"detector_{config.modalities[modality]}",
        config.detector,
        untrained=untrained,
        problem=problem,
        trained=trained,
    )


def detect(
    key: Key,
    config: Config,
    *,
    surveys: Surveys,
    trained: tuple[Detector, ...],
    taken_for: Int[Array, "S N"] | None = None,
) -> Detections:
    """Applies the detectors to the surveys that they were not trained on.

    Looks for training are sorted by `[S, N]` classes `taken_for`, by default the true ones.
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
    of_bank = others.classes[for_bank] if taken_for is None else taken_for
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
