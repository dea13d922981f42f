"""Stages of perception: scenes, detectors, the JMVAE and fusion."""

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxsense import looks
from jaxsense.config import Config
from jaxsense.core.networks import Params
from jaxsense.core.supervised import FitState
from jaxsense.core.types import Belief, Key, Samples, pytree
from jaxsense.models import make_jmvae, make_prior, make_readout
from jaxsense.sim import sensors
from jaxsense.sim.arena import Arena
from jaxsense.sim.sensors import Sensor
from jaxsense.sim.world import Scene, make_world
from jaxsense.training import gating, histories, repeats
from jaxsense.training.fits import fit_stage, jmvae_restarts
from jaxsense.training.gating import Examples
from jaxsense.training.stage import Stage
from jaxsense.vae import detectors, jmvae
from jaxsense.vae import gate as gates
from jaxsense.vae.detectors import Classifier, Detector

_EXACT = 0.003  # nats that a readout may lose, a third of what a sound map may
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

    def looks(self, modality: int) -> gates.Looks:
        """All looks by one modality, scene after scene.

        Args:
          modality: index of the sensor.
        """
        windows = self.windows[modality]
        # XLA would fold the reshape into sums over the looks, which then round otherwise.
        flat = jax.lax.optimization_barrier(windows.reshape(-1, windows.shape[-1]))
        return gates.Looks(flat, self.distances[:, modality].reshape(-1))


@pytree
class Surveys:
    """Surveys of all scenes.

    Attributes:
      training: of the scenes to train detectors with.
      others: of those for the bank, to measure on, and empty ones, in this order.
    """

    training: Survey
    others: Survey


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


def num_scenes(config: Config) -> tuple[int, int, int, int]:
    """Numbers of scenes to train detectors with, for the bank, to measure on, and empty ones."""
    num_pois, num_classes = config.arena.num_pois, len(config.arena.classes)
    num_bank = -(-config.jmvae.samples_per_class * num_classes // num_pois)
    num_held_out = -(-_held_out_per_class(config) * num_classes // num_pois)
    num_train = -(-config.detector.num_scans // num_pois)
    num_empty = -(-num_train // _SHARE_OF_EMPTY)
    num_for_starts = _num_starts(config) * config.jmvae.num_together
    parts = num_train, max(num_bank, num_for_starts), num_held_out
    num_train, num_bank, num_held_out = (_whole(number, config) for number in parts)
    return num_train, num_bank, num_held_out, num_empty


def _whole(number: int, config: Config) -> int:
    """A number of scenes in whole groups that show the same PoIs."""
    return -(-number // config.jmvae.num_together) * config.jmvae.num_together


def _held_out_per_class(config: Config) -> int:
    """Number of held-out looks at each class."""
    return -(-config.detector.num_held_out // len(config.arena.classes))


def _num_starts(config: Config) -> int:
    """Number of surveyed scenes in which episodes start; 0 unless looks are live."""
    return config.dqn.num_starts if config.dqn.observe == "live" else 0


Scenes = tuple[Key, Int[Array, "S N"], Bool[Array, " S"], Key | None]
"""Keys, classes, which are empty, and keys of the PoIs' places, see `draw_scenes`."""


def draw_scenes(key: Key, config: Config) -> Scenes:
    """Draws keys and classes of all scenes.

    Args:
      key: random key.
      config: all settings.

    Returns:
      `[S]` keys of the scenes, `[S, N]` int32 classes of their PoIs, `[S]` bool, in which scenes
      no look shows its PoI, and `[S]` keys of the PoIs' places, of which `jmvae.looks` in a row are
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


def survey_stage(arena: Arena) -> Stage:
    """Makes the stage that surveys all scenes together: compiling takes longer than running.

    It may get a part of the scenes, and knows nothing of their number.
    """

    def survey(key: Key, config: Config, *, scenes: Scenes) -> Survey:
        del key
        keys, classes, is_empty, places = scenes
        world = make_world(config, arena=arena)
        seen, windows, distances = looks.surveys(keys, world, classes, is_empty, places)
        return Survey(classes, seen, windows, distances)

    given = {"scenes": "scenes"}
    return Stage("survey", survey, given, divide=divide, is_passing=True, has_rows=True)


def divide(config: Config, survey: Survey) -> Surveys:
    """Divides the survey of all scenes by what it is for.

    Args:
      config: all settings.
      survey: of all scenes.
    """
    number = num_scenes(config)[0]
    return Surveys(_rows(survey, slice(number)), _rows(survey, slice(number, None)))


def _rows(survey: Survey, part: slice) -> Survey:
    """The survey of some of the scenes."""
    return jax.tree.map(lambda x: x[part], survey)


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
        empty = _rows(surveys.others, slice(-num_empty, None)).looks(m)
        checks = _rows(surveys.others, slice(num_bank)).looks(m)
        return Examples(
            labels=jnp.array(config.label_of_class(name))[classes],
            distances=shown.distances,
            nothing=gating.nothing(key, config.viewpoint, sensor, shown, empty),
            checks=jax.tree.map(lambda x: x[: gating.NUM_CHECKS], checks),
        )

    keys = jax.random.split(key, len(config.modalities))
    names, made = config.modalities, sensors.make(config)
    return tuple(of_modality(keys[m], m, names[m], made[m]) for m in range(len(names)))


def detector_stage(modality: int, name: str, config: Config) -> Stage:
    """Makes the stage that trains the detector of one modality.

    Args:
      modality: index of the sensor.
      name: of the stage.
      config: all settings.
    """

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
        name,
        {"surveys": "survey", "examples": "examples"},
        config,
        settings=lambda config: config.detector,
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
    others = _rows(surveys.others, slice(-num_empty))
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
    rows = slice(0, _num_starts(config) * together, together)
    return Detections(
        bank=by_class(features, for_bank, of_bank, config.jmvae.samples_per_class),
        held_out=by_class(features, for_measuring, of_measuring, _held_out_per_class(config)),
        starts=jax.tree.map(lambda x: x[rows], starts),
        windows=by_class(others.windows, for_measuring, of_measuring, 1),
    )


def make_stages(config: Config, arena: Arena) -> list[Stage]:
    """Makes the stages from surveys to detections, class beliefs and novelty, with detectors.

    Args:
      config: all settings.
      arena: of the simulation.
    """
    names = tuple(f"detector_{name}" for name in config.modalities)
    given = {"params": "best_jmvae", "detections": "detections"}
    return [
        *(detector_stage(m, name, config) for m, name in enumerate(names)),
        Stage("detections", detect, {"surveys": "survey", "trained": names}),
        *jmvae_stages(config),
        Stage("class_beliefs", class_beliefs, given, is_kept=True),
        repeats.novelty_stage(arena, config),
    ]


def jmvae_stages(config: Config) -> list[Stage]:
    """Makes stages that train the JMVAE from different random parameters, and pick the best."""

    def problem(config: Config, *, detections: Detections) -> jmvae.Fitting:
        return jmvae.Fitting(config.jmvae, detections.bank, make_jmvae(config))

    def init(key: Key, config: Config) -> Params:
        return jmvae.init(key, make_jmvae(config))

    given = {"detections": "detections"}
    restarts = jmvae_restarts(config, given, init=init, problem=problem)
    names = tuple(stage.name for stage in restarts)
    best = Stage("best_jmvae", _best_jmvae, {"restarts": names, **given}, is_kept=True)
    return [*restarts, best]


def _best_jmvae(
    key: Key,
    config: Config,
    *,
    restarts: tuple[tuple[Params, jax.Array], ...],
    detections: Detections,
) -> Params:
    """Parameters of the best restart, of finite ones; of the first if none is finite.

    It has the lowest loss of those whose beliefs class probabilities are read from exactly; if
    there are none, it is the one from which they are read most exactly.
    """
    if len(restarts) == 1:
        return restarts[0][0]
    losses = jnp.stack([loss for _, loss in restarts])
    params = jax.tree.map(lambda *x: jnp.stack(x), *(params for params, _ in restarts))

    def error(params: Params) -> jax.Array:
        classes = class_beliefs(key, config, params=params, detections=detections)
        read, prior = make_readout(config, classes), make_prior(config)
        of_belief = lambda belief: read.class_probabilities(belief, prior)  # noqa: E731
        return histories.readout_error(key, config, detections.bank, classes, of_belief)

    errors = jax.lax.map(error, params)
    inexact = jnp.maximum(errors - _EXACT, 0.0)
    is_finite = jnp.isfinite(losses) & jnp.isfinite(inexact)
    worst_last = [jnp.where(is_finite, x, jnp.inf) for x in (losses, inexact)]
    best = jnp.lexsort(worst_last)[0]
    return jax.tree.map(lambda x: x[best], params)


def class_beliefs(key: Key, config: Config, *, params: Params, detections: Detections) -> Belief:
    """Mean joint posterior of each class, `[C, D]`, from features for training.

    Args:
      key: not used.
      config: all settings.
      params: of the JMVAE.
      detections: see `detect`.
    """
    del key
    model = make_jmvae(config)
    encode = jax.vmap(jax.vmap(lambda features: jmvae.posterior(params, model, features)))
    return jax.tree.map(lambda x: x.mean(axis=1), encode(detections.bank))
