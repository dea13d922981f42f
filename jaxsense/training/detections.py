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
from jaxsense.sim import sensors
from jaxsense.sim.sensors import Sensor
from jaxsense.sim.world import Scene
from jaxsense.training import gating
from jaxsense.training.gating import Examples
from jaxsense.training.stage import Stage, fit_stage
from jaxsense.training.surveys import Surveys, held_out_per_class, num_scenes, num_starts
from jaxsense.vae import detectors
from jaxsense.vae import gate as gates
from jaxsense.vae.detectors import Classifier, Detector


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


def split_examples(key: Key, config: Config, *, surveys: Surveys) -> tuple[Examples, ...]:
    """What to train each detector and its gate on, besides the windows of the surveys.

    Args:
      key: random key of the windows that are spoilt by hand.
      config: all settings.
      surveys: of all scenes.
    """
    _, num_bank, _, num_empty = num_scenes(config)

    def of_modality(key: Key, m: int, name: str, sensor: Sensor) -> Examples:
        shown, classes = surveys.training.looks(m), surveys.training.classes.reshape(-1)
        empty = surveys.others.of_scenes(slice(-num_empty, None)).looks(m)
        checks = surveys.others.of_scenes(slice(num_bank)).looks(m)
        return Examples(
            labels=jnp.array(config.label_of_class(name))[classes],
            distances=shown.distances,
            nothing=gating.nothing(key, config.viewpoint, sensor, shown, empty),
            checks=jax.tree.map(lambda x: x[: gating.NUM_CHECKS], checks),
        )

    keys = jax.random.split(key, len(config.modalities))
    names, made = config.modalities, sensors.make(config)
    return tuple(of_modality(keys[m], m, names[m], made[m]) for m in range(len(names)))


def detector_stage(modality: int, config: Config) -> Stage:
    """Makes the stage that trains the detector of one modality, by its index."""

    def untrained(
        key: Key, config: Config, *, surveys: Surveys, examples: tuple[Examples, ...]
    ) -> tuple[Classifier, tuple[Params, Params]]:
        num_labels = len(config.labels(config.modalities[modality]))
        number = _num_training(config, examples[modality])
        windows = surveys.training.looks(modality).windows[:number]
        is_range = sensors.make(config)[modality].measures_distance
        detector = detectors.init(key, windows, num_labels, config.detector, is_range)
        return detector, (detector.params, detector.gate.params)

    def problem(
        config: Config, detector: Classifier, *, surveys: Surveys, examples: tuple[Examples, ...]
    ) -> gating.FittingBoth:
        number = _num_training(config, examples[modality])
        given = gating.first(examples[modality], number)
        windows = surveys.training.looks(modality).windows[:number]
        return gating.FittingBoth(
            detectors.Fitting(config.detector, detector, windows, given.labels),
            gating.of_gate(config.detector, detector.gate, given, windows),
        )

    def trained(
        config: Config,
        detector: Classifier,
        fit: FitState,
        *,
        surveys: Surveys,
        examples: tuple[Examples, ...],
    ) -> Classifier:
        given = examples[modality]
        number = _num_training(config, given)
        params, of_gate = fit.params
        gate = gates.fitted(of_gate, gating.checks_of(config.detector, detector.gate, given))
        found = dataclasses.replace(detector, params=params, gate=gate)
        windows = surveys.training.looks(modality).windows[number:]
        labels = given.labels[number:]
        return detectors.calibrate(found, windows, labels) if len(labels) else found

    return fit_stage(
        f"detector_{config.modalities[modality]}",
        config.detector,
        untrained=untrained,
        problem=problem,
        trained=trained,
    )


def _num_training(config: Config, examples: Examples) -> int:
    """How many examples train the detector; the others calibrate it."""
    return config.detector.num_training(len(examples.labels))


def detect(
    key: Key,
    config: Config,
    *,
    surveys: Surveys,
    trained: tuple[Detector, ...],
    taken_for: Int[Array, "S N"] | None = None,
) -> Detections:
    """Applies the detectors to the surveys that they were not trained on.

    Args:
      key: not used.
      config: all settings.
      surveys: of all scenes.
      trained: one detector for each modality.
      taken_for: `[S, N]` int32 classes by which looks for training are sorted; by default the true
        ones.
    """
    del key
    _, num_bank, _, num_empty = num_scenes(config)
    others = surveys.others.of_scenes(slice(-num_empty))
    features = looks.detect_all(trained, others.windows)

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
