"""Stages of a JMVAE that learns from scans themselves, and whose encoders serve as detectors.

Looks are grouped by the PoI that they show; no label enters the training. Clusters of the joint
posteriors are the classes. The labels of the training scenes only name them: each class is the
cluster that holds most of its PoIs. From then on, what all looks at a PoI show is its class.
"""

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxsense.config import Config
from jaxsense.core.networks import Params
from jaxsense.core.supervised import FitState
from jaxsense.core.types import Belief, Key, pytree
from jaxsense.models import make_encoder, make_frame, make_shape
from jaxsense.sim import sensors
from jaxsense.training import detections, stage
from jaxsense.training.detections import Detections
from jaxsense.training.repeats import Repeated
from jaxsense.training.stage import Stage, fit_stage
from jaxsense.training.surveys import Scenes, Survey, Surveys, num_scenes
from jaxsense.vae import detectors, frames, leave_one_out
from jaxsense.vae.detectors import Looks
from jaxsense.vae.frames import Scaling
from jaxsense.vae.leave_one_out import Encoder, Groups

_POSTERIORS_AT_ONCE = 4096
_CLUSTERED = 8192  # PoIs


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
class Views:
    """What a JMVAE learns from.

    Attributes:
      groups: looks at the PoIs of training scenes, each sensor's in its frame.
      scalings: by modality, how it comes to this frame.
    """

    groups: Groups
    scalings: tuple[Scaling, ...]


def views(key: Key, config: Config, *, surveys: Surveys) -> Views:
    """Looks at the PoIs of the training scenes, in the frames of their sensors.

    Args:
      key: not used.
      config: all settings.
      surveys: of all scenes.
    """
    del key
    number = _num_training(config)
    found, scalings = [], []
    for sensor, windows in zip(sensors.make(config), surveys.training.windows, strict=True):
        groups = grouped(windows[:number], config)
        flat = groups.reshape(-1, groups.shape[-1])
        scaling, seen = frames.scaled(make_frame(config, sensor), flat)
        found.append(seen.reshape(*groups.shape[:2], -1))
        scalings.append(scaling)
    return Views(tuple(found), tuple(scalings))


def _num_training(config: Config) -> int:
    """Training scenes to learn from, in whole groups; the others calibrate the encoders."""
    together = config.jmvae.num_together
    return together * config.detector.num_training(num_scenes(config)[0] // together)


def grouped(windows: Float[Array, "S N F"], config: Config) -> Float[Array, "P K F"]:
    """Looks grouped by PoI.

    Args:
      windows: `[S, N, F]` of scenes of which K in a row show the same PoIs.
      config: all settings.
    """
    looks, (_, num_pois, size) = config.jmvae.num_together, windows.shape
    return jnp.swapaxes(windows.reshape(-1, looks, num_pois, size), 1, 2).reshape(-1, looks, size)


def restarts(config: Config) -> list[Stage]:
    """Makes the stages that train the JMVAE from different random parameters."""

    def untrained(key: Key, config: Config, *, views: Views) -> tuple[tuple[()], Params]:
        del views
        return (), leave_one_out.init(key, make_shape(config))

    def problem(config: Config, _: tuple[()], *, views: Views) -> leave_one_out.Fitting:
        return leave_one_out.Fitting(config.jmvae, views.groups, make_shape(config))

    return stage.restarts(config, untrained=untrained, problem=problem)


def best(key: Key, config: Config, *, restarts: tuple[tuple[Params, jax.Array], ...]) -> Params:
    """Parameters of the restart with the lowest finite loss; of the first if none is finite."""
    losses = jnp.stack([loss for _, loss in restarts])
    found = jnp.argmin(jnp.where(jnp.isfinite(losses), losses, jnp.inf))
    params = jax.tree.map(lambda *x: jnp.stack(x), *(params for params, _ in restarts))
    return jax.tree.map(lambda x: x[found], params)


def _posteriors(params: Params, config: Config, groups: Groups) -> Belief:
    """`[P, D]` posteriors of all looks at each PoI."""
    shape = make_shape(config)
    batch = min(_POSTERIORS_AT_ONCE, len(groups[0]))
    of_group = lambda looks: leave_one_out.posterior(params, shape, looks)  # noqa: E731
    return jax.lax.map(of_group, groups, batch_size=batch)


def class_beliefs(
    key: Key, config: Config, *, params: Params, views: Views, surveys: Surveys
) -> Belief:
    """Mean joint posterior of each class, `[C, D]`, from clusters that labels only name.

    Args:
      key: random key of the clusters.
      config: all settings.
      params: of the JMVAE.
      views: what it has learned from.
      surveys: of all scenes, for the labels.
    """
    number, num_classes = _num_training(config), len(config.arena.classes)
    found = _posteriors(params, config, views.groups)
    truth = surveys.training.classes[: number : config.jmvae.num_together].reshape(-1)
    centres = leave_one_out.centres(key, found.mean[:_CLUSTERED], num_classes)
    members = leave_one_out.nearest(found.mean, centres)
    of_class = leave_one_out.named(members, truth, num_classes)
    is_member = (members[None] == of_class[:, None]).astype(jnp.float32)
    share = is_member / jnp.maximum(jnp.sum(is_member, axis=1, keepdims=True), 1)
    return jax.tree.map(lambda x: jnp.sum(share[..., None] * x[None], axis=1), found)


def encoder_stage(modality: int, config: Config) -> Stage:
    """The stage that makes a detector of the encoder of one modality: it learns where PoIs are."""

    def num_looks(config: Config) -> int:
        return _num_training(config) * config.arena.num_pois

    def untrained(
        key: Key,
        config: Config,
        *,
        surveys: Surveys,
        examples: tuple[Looks, ...],
        params: Params,
        views: Views,
        classes: Belief,
        shown: Shown,
    ) -> tuple[Encoder, Params]:
        del examples
        number, windows = num_looks(config), surveys.training.looks(modality).windows
        scaling = views.scalings[modality]
        encoder = make_encoder(key, config, modality, windows[:number], params, scaling, classes)
        if number < len(windows):
            taken_for = shown.calibrating.reshape(-1)
            encoder = leave_one_out.calibrate(encoder, windows[number:], taken_for)
        return encoder, encoder.presence.params

    def problem(
        config: Config,
        encoder: Encoder,
        *,
        surveys: Surveys,
        examples: tuple[Looks, ...],
        **_: object,
    ) -> detectors.Fitting:
        number, looks = num_looks(config), surveys.training.looks(modality)
        first, one_label = jax.tree.map(lambda x: x[:number], looks), jnp.zeros(number, jnp.int32)
        return detections.fitting(config, encoder.presence, first, one_label, examples[modality])

    def trained(
        config: Config,
        encoder: Encoder,
        fit: FitState,
        *,
        surveys: Surveys,
        examples: tuple[Looks, ...],
        **_: object,
    ) -> Encoder:
        presence = dataclasses.replace(encoder.presence, params=fit.params)
        nothing = examples[modality]
        presence = detections.fitted(config, presence, surveys, modality, nothing)
        return dataclasses.replace(encoder, presence=presence)

    return fit_stage(
        f"detector_{config.modalities[modality]}",
        config.detector,
        untrained=untrained,
        problem=problem,
        trained=trained,
    )


def shown(
    key: Key, config: Config, *, surveys: Surveys, params: Params, views: Views, classes: Belief
) -> Shown:
    """What all looks at PoIs show together, which takes the place of labels.

    Args:
      key: not used.
      config: all settings.
      surveys: of all scenes.
      params: of the JMVAE.
      views: for the frames of the sensors.
      classes: `[C, D]` mean joint posterior of each class.
    """
    del key
    num_train, num_bank, _, _ = num_scenes(config)

    def of_scenes(survey: Survey, part: slice) -> jax.Array:
        if part.start == part.stop:
            return jnp.zeros((0, config.arena.num_pois), jnp.int32)
        of_groups = _shown(config, params, views, classes, survey, part)
        of_groups = of_groups.reshape(-1, config.arena.num_pois)
        return jnp.repeat(of_groups, config.jmvae.num_together, axis=0)

    calibrating = slice(_num_training(config), num_train)
    return Shown(
        of_scenes(surveys.training, calibrating), of_scenes(surveys.others, slice(0, num_bank))
    )


def detect(
    key: Key, config: Config, *, surveys: Surveys, trained: tuple[Encoder, ...], shown: Shown
) -> Detections:
    """Applies the encoders to the surveys that nothing was trained on.

    Looks for training are sorted by the class that all looks at the PoI show, not by its label;
    held-out looks by their labels.

    Args:
      key: not used.
      config: all settings.
      surveys: of all scenes.
      trained: one encoder for each modality.
      shown: what all looks at the PoIs show.
    """
    return detections.detect(key, config, surveys=surveys, trained=trained, taken_for=shown.bank)


def repeated(key: Key, config: Config, *, scenes: Scenes, shown: Shown) -> Repeated:
    """Scenes with PoIs of the bank, in another light, of which it is known what all looks show.

    Args:
      key: not used.
      config: all settings.
      scenes: see `surveys.draw_scenes`.
      shown: what all looks at the PoIs show.
    """
    del key
    _, classes, _, places = scenes
    assert places is not None
    number, together = config.detector.num_repeats, config.jmvae.num_together
    # One scene of each group; from the first again if there are fewer.
    rows = jnp.arange(number) * together % len(shown.bank)
    of_bank = num_scenes(config)[0] + rows
    return Repeated(classes[of_bank], places[of_bank], shown.bank[rows, 0])


def _shown(
    config: Config,
    params: Params,
    views: Views,
    classes: Belief,
    survey: Survey,
    part: slice,
    first: int | None = None,
) -> jax.Array:
    """`[P]` int32 classes that the first looks by each sensor, or all, show together."""
    groups = tuple(
        jax.lax.map(jax.vmap(scaling), grouped(x[part], config)[:, :first], batch_size=512)
        for scaling, x in zip(views.scalings, survey.windows, strict=True)
    )
    return leave_one_out.nearest(_posteriors(params, config, groups).mean, classes.mean)


def accuracies(
    key: Key, config: Config, *, surveys: Surveys, params: Params, views: Views, classes: Belief
) -> dict[str, Float[Array, ""]]:
    """Share of held-out PoIs whose joint posterior is nearest to the true class.

    Args:
      key: not used.
      config: all settings.
      surveys: of all scenes.
      params: of the JMVAE.
      views: for the frames of the sensors.
      classes: `[C, D]` mean joint posterior of each class.

    Returns:
      `pair` after one look by each sensor, and `all_looks` after four by each.
    """
    del key
    _, num_bank, num_held_out, _ = num_scenes(config)
    part = slice(num_bank, num_bank + num_held_out)
    truth = surveys.others.classes[part][:: config.jmvae.num_together].reshape(-1)

    def share(first: int | None) -> jax.Array:
        shown = _shown(config, params, views, classes, surveys.others, part, first)
        return jnp.mean(shown == truth)

    return {"pair": share(1), "all_looks": share(None)}
