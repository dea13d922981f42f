"""The whole training as one pure function, to be vmapped over seeds and settings.

`pipeline` runs the same stages one by one, reports progress and saves checkpoints; here they are a
single program. Both spend the same keys on the same stages and agree until rounding, which is not
the same in another program, makes learning part ways.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from jaxsense import examine
from jaxsense.config import Config
from jaxsense.dqn import training as dqn
from jaxsense.models import Models, jmvae_shape
from jaxsense.networks import Params
from jaxsense.observe import Bank
from jaxsense.programs import (
    best_restart,
    chunks_of,
    episode_starts,
    keys_of,
    make_map_mdp,
    num_held_out_per_class,
    num_scene_starts,
    num_scenes,
    survey_scenes,
)
from jaxsense.sim.world import World
from jaxsense.types import Belief, Key
from jaxsense.vae import detectors, jmvae
from jaxsense.vae.detectors import Detector


@struct.dataclass
class Perception:
    """Detectors and a JMVAE, and the detections that they were trained on.

    Attributes:
      trained: the detectors.
      params: of the JMVAE.
      bank: for each modality `[C, S, D_m]` detections that the JMVAE was trained on.
      held_out: the same from other scenes, for measuring.
      starts: what episodes start in, see `Detections`.
      windows: for each modality `[C, 1, F]` one held-out look at each class.
      accuracy: `[M]` of the detectors, on held-out looks.
      is_finite: `[]` whether all losses are.
    """

    trained: tuple[Detector, ...]
    params: Params
    bank: Bank
    held_out: Bank
    starts: Any
    windows: tuple[jax.Array, ...]
    accuracy: jax.Array
    is_finite: jax.Array


@struct.dataclass
class Learned:
    """What a whole training gives.

    Attributes:
      perception: detectors and JMVAE.
      models: the trained networks.
      posteriors: for each set of modalities, `[C, S, D]` beliefs of held-out detections.
      latent: the summary's block `jmvae` as arrays.
      reward: `[M, epochs]` mean total reward of the episodes that ended; NaN where none did.
      totals: `[M, P, S]` total rewards, see `examine.play`.
      firsts: `[M, P, S]` rewards of the first actions.
      is_finite: `[]` whether all losses are.
    """

    perception: Perception
    models: Models
    posteriors: dict[str, Belief]
    latent: dict[str, Any]
    reward: jax.Array
    totals: jax.Array
    firsts: jax.Array
    is_finite: jax.Array


def learn(key: Key, config: Config, world: World) -> Learned:
    """Detectors, JMVAE and one Q-network for each modality, from simulated scans.

    Args:
      key: the only source of randomness.
      config: all settings; see `sweep.vary` for those that may be traced.
      world: from `sim.make_world(config)`.

    Returns:
      The trained networks and what they are worth.
    """
    # The first keys are those of `learn_perception`, the fourth is that of missions.
    dqn_keys = keys_of(key, 4 + len(config.modalities))[4:]
    perception = learn_perception(key, config, world)
    trained, params, bank = perception.trained, perception.params, perception.bank
    posteriors, latent = examine.latent_space(params, perception.held_out, config)
    mdp, settings = make_map_mdp(config, world, trained, params, bank), config.dqn

    def learn_policy(inputs: tuple[jax.Array, Key]):
        modality, key = inputs
        train_key, examine_key = keys_of(key, 2)
        start_key, init_key, *chunk_keys = keys_of(train_key, 2 + settings.epochs // settings.chunk)
        prepared = episode_starts(start_key, mdp, config, perception.starts)
        state, infos = jax.lax.scan(
            lambda state, key: dqn.train_chunk(key, mdp, modality, settings, state, prepared),
            dqn.init(init_key, mdp, settings, prepared),
            jnp.stack(chunk_keys),
        )
        info = jax.tree.map(lambda x: x.reshape(-1), infos)
        examined = modality, state.params, params, perception.held_out, config
        reward = jnp.where(info.episodes > 0, info.episode_return, jnp.nan)
        return state.params, info.is_finite, reward, *examine.play(examine_key, *examined)

    # One after the other: compiled once, and no slower than side by side.
    modalities = jnp.arange(len(config.modalities)), jnp.stack(dqn_keys)
    q_networks, is_finite, reward, totals, firsts = jax.lax.map(learn_policy, modalities)
    return Learned(
        perception=perception,
        models=Models(
            detectors=trained,
            jmvae=params,
            class_beliefs=jax.tree.map(lambda x: x.mean(axis=1), posteriors["joint"]),
            q_networks=tuple(
                jax.tree.map(lambda x: x[m], q_networks)  # noqa: B023
                for m in range(len(config.modalities))
            ),
        ),
        posteriors=posteriors,
        latent=latent,
        reward=reward,
        totals=totals,
        firsts=firsts,
        is_finite=perception.is_finite & is_finite.all(),
    )


def learn_perception(key: Key, config: Config, world: World) -> Perception:
    """Detectors and the JMVAE; see `learn` for the arguments."""
    survey_key, detector_key, jmvae_key = keys_of(key, 3)
    num_train, num_bank, _ = num_scenes(config)
    surveys = survey_scenes(survey_key, jnp.arange(sum(num_scenes(config))), config, world)
    labels = [jnp.array(config.label_of_class(name)) for name in config.modalities]
    detector_keys = keys_of(detector_key, len(config.modalities))
    found = [
        _train_detector(k, w[:num_train], label[surveys.classes[:num_train]], size, config)
        for k, w, label, size in zip(
            detector_keys, surveys.windows, labels, jmvae_shape(config).feature_sizes, strict=True
        )
    ]
    trained = tuple(detector for detector, _ in found)
    classes, scenes = jax.tree.map(lambda x: x[num_train:], (surveys.classes, surveys.scenes))
    detect = jax.vmap(jax.vmap(detectors.detect, in_axes=(None, 0)), in_axes=(None, 0))
    features = tuple(
        detect(d, w[num_train:]) for d, w in zip(trained, surveys.windows, strict=True)
    )

    def by_class(values: jax.Array, part: slice, number: int) -> jax.Array:
        return _by_class(values[part], classes[part], config, number)

    for_bank, for_measuring = slice(None, num_bank), slice(num_bank, None)
    bank = tuple(by_class(f, for_bank, config.jmvae.samples_per_class) for f in features)
    number = num_held_out_per_class(config)
    held_out = tuple(by_class(f, for_measuring, number) for f in features)
    params, losses = _train_jmvae(jmvae_key, bank, config)
    is_right = [
        f.argmax(axis=-1) == label[:, None] for f, label in zip(held_out, labels, strict=True)
    ]
    is_finite = [jnp.isfinite(x).all() for x in (losses, *(losses for _, losses in found))]
    starts = classes, scenes, features
    return Perception(
        trained=trained,
        params=params,
        bank=bank,
        held_out=held_out,
        starts=jax.tree.map(lambda x: x[: num_scene_starts(config)], starts),
        windows=tuple(by_class(w[num_train:], for_measuring, 1) for w in surveys.windows),
        accuracy=jnp.stack([right.mean() for right in is_right]),
        is_finite=jnp.stack(is_finite).all(),
    )


def _train_detector(
    key: Key, windows: jax.Array, labels: jax.Array, num_labels: int, config: Config
) -> tuple[Detector, jax.Array]:
    """A detector trained on `[S, N, F]` windows, and its `[steps]` losses."""
    settings, (number, size) = config.detector, chunks_of(config.detector.steps)
    init_key, *chunk_keys = keys_of(key, 1 + number)
    windows, labels = windows.reshape(-1, windows.shape[-1]), labels.reshape(-1)
    detector = detectors.init(init_key, windows, num_labels, settings)
    state, losses = jax.lax.scan(
        lambda state, key: detectors.train(key, state, detector, windows, labels, settings, size),
        detectors.start(detector, settings),
        jnp.stack(chunk_keys),
    )
    losses = losses.reshape(-1)[: settings.steps]
    return dataclasses.replace(detector, params=state.params), losses


def _train_jmvae(key: Key, bank: Bank, config: Config) -> tuple[Params, jax.Array]:
    """The JMVAE with the lowest loss at the end, of several, and its losses."""
    settings, model = config.jmvae, jmvae_shape(config)
    number, size = chunks_of(settings.steps)

    def train(key: Key):
        init_key, *chunk_keys = keys_of(key, 1 + number)
        state, losses = jax.lax.scan(
            lambda state, key: jmvae.train(key, state, model, bank, settings, size),
            jmvae.start(jmvae.init(init_key, model), settings),
            jnp.stack(chunk_keys),
        )
        return state.params, losses.reshape(-1)[: settings.steps]

    params, losses = jax.lax.map(train, jnp.stack(keys_of(key, settings.restarts)))
    best = best_restart(losses, settings)
    return jax.tree.map(lambda x: x[best], params), losses[best]


def _by_class(values: jax.Array, classes: jax.Array, config: Config, number: int) -> jax.Array:
    """`[C, number, ...]` from `[S, N, ...]` looks of at least that many of each class."""
    flat, classes = values.reshape(-1, *values.shape[2:]), classes.reshape(-1)
    each = range(len(config.arena.classes))
    rows = jnp.stack([jnp.nonzero(classes == c, size=number)[0] for c in each])
    return flat[rows]
