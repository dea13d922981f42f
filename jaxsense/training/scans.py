"""Stages of a JMVAE that learns from scans themselves, and whose encoders serve as detectors.

Looks are grouped by the PoI that they show; no label enters the training. Clusters of the joint
posteriors are the classes. The labels of the training scenes only name them: each class is the
cluster that holds most of its PoIs. From then on, what all looks at a PoI show is its class.
"""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsense.config import Config
from jaxsense.core.networks import Params
from jaxsense.core.types import Belief, Key, pytree
from jaxsense.models import make_encoder, make_frame, make_scan_jmvae
from jaxsense.sim import sensors
from jaxsense.training.detections import Shown, Survey, Surveys, detector_stage, num_training
from jaxsense.training.stage import Fit, Stage
from jaxsense.vae import frames, leave_one_out
from jaxsense.vae.detectors import Classifier
from jaxsense.vae.frames import Scaling
from jaxsense.vae.leave_one_out import Encoder, Groups

_POSTERIORS_AT_ONCE = 4096
_CLUSTERED = 8192  # PoIs


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
    """Looks at the PoIs of the training scenes, in the frames of their sensors."""
    del key
    number = _num_scenes(config)
    found, scalings = [], []
    for sensor, windows in zip(sensors.make(config), surveys.training.windows, strict=True):
        groups = grouped(windows[:number], config)
        flat = groups.reshape(-1, groups.shape[-1])
        scaling, seen = frames.scaled(make_frame(config, sensor), flat)
        found.append(seen.reshape(*groups.shape[:2], -1))
        scalings.append(scaling)
    return Views(tuple(found), tuple(scalings))


def start(config: Config, *, views: Views) -> Fit:
    """The fit of a JMVAE to views."""
    model = make_scan_jmvae(config)
    problem = leave_one_out.problem(config.jmvae, views.groups, model)
    return Fit.of_params(functools.partial(leave_one_out.init, model=model), problem)


def _num_scenes(config: Config) -> int:
    """Training scenes to learn from; the others calibrate the encoders."""
    return num_training(config) // config.arena.num_pois


def grouped(windows: Float[Array, "S N F"], config: Config) -> Float[Array, "P K F"]:
    """Looks grouped by PoI, of scenes of which K in a row show the same PoIs."""
    looks, (_, num_pois, size) = config.jmvae.num_together, windows.shape
    return jnp.swapaxes(windows.reshape(-1, looks, num_pois, size), 1, 2).reshape(-1, looks, size)


def _posteriors(params: Params, config: Config, groups: Groups) -> Belief:
    """`[P, D]` posteriors of all looks at each PoI."""
    model = make_scan_jmvae(config)
    batch = min(_POSTERIORS_AT_ONCE, len(groups[0]))
    of_group = lambda looks: leave_one_out.posterior(params, model, looks)  # noqa: E731
    return jax.lax.map(of_group, groups, batch_size=batch)


def class_beliefs(
    key: Key, config: Config, *, params: Params, views: Views, surveys: Surveys
) -> Belief:
    """Mean joint posterior of each class, `[C, D]`, from clusters that labels only name."""
    number, num_classes = _num_scenes(config), len(config.arena.classes)
    found = _posteriors(params, config, views.groups)
    truth = surveys.training.classes[: number : config.jmvae.num_together].reshape(-1)
    centres = leave_one_out.centres(key, found.mean[:_CLUSTERED], num_classes)
    members = leave_one_out.nearest(found.mean, centres)
    of_class = leave_one_out.named(members, truth, num_classes)
    is_member = (members[None] == of_class[:, None]).astype(jnp.float32)
    share = is_member / jnp.maximum(jnp.sum(is_member, axis=1, keepdims=True), 1)
    return jax.tree.map(lambda x: jnp.sum(share[..., None] * x[None], axis=1), found)


def encoder_stage(modality: int, config: Config) -> Stage:
    """Makes the stage that makes a detector of the encoder of one modality."""
    number = num_training(config)

    def encoder(
        config: Config,
        presence: Classifier,
        *,
        surveys: Surveys,
        params: Params,
        views: Views,
        classes: Belief,
        shown: Shown,
    ) -> Encoder:
        scaling = views.scalings[modality]
        found = make_encoder(config, modality, presence, params, scaling, classes)
        windows = surveys.training.looks(modality).windows[number:]
        if not len(windows):
            return found
        return leave_one_out.calibrate(found, windows, shown.calibrating.reshape(-1))

    return detector_stage(modality, config, encoder)


def shown(
    key: Key, config: Config, *, surveys: Surveys, params: Params, views: Views, classes: Belief
) -> Shown:
    """What all looks at PoIs show together, which takes the place of labels."""
    del key

    def of_scenes(survey: Survey) -> jax.Array:
        if not len(survey.classes):
            return survey.classes
        groups = tuple(
            jax.lax.map(jax.vmap(scaling), grouped(x, config), batch_size=512)
            for scaling, x in zip(views.scalings, survey.windows, strict=True)
        )
        found = leave_one_out.nearest(_posteriors(params, config, groups).mean, classes.mean)
        classes_shown = found.reshape(-1, config.arena.num_pois)
        return jnp.repeat(classes_shown, config.jmvae.num_together, axis=0)

    calibrating = surveys.training.of_scenes(slice(_num_scenes(config), None))
    return Shown(of_scenes(calibrating), of_scenes(surveys.bank))
