"""The whole training as one pure function, to be vmapped over seeds and settings.

`pipeline` runs the same stages one by one, reports progress and saves checkpoints; here they are a
single program. Keys are spent differently, so that the two agree in distribution, not in bits.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from jaxsense import examine, observe
from jaxsense.config import Config
from jaxsense.dqn import training as dqn
from jaxsense.models import Models, jmvae_shape
from jaxsense.networks import Params
from jaxsense.observe import Bank
from jaxsense.programs import last_steps, num_held_out_per_class
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
      windows: for each modality `[C, 1, F]` one held-out look at each class.
      accuracy: `[M]` of the detectors, on held-out looks.
      is_finite: `[]` whether all losses are.
    """

    trained: tuple[Detector, ...]
    params: Params
    bank: Bank
    held_out: Bank
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
    perception_key, dqn_key = jax.random.split(key)
    perception = learn_perception(perception_key, config, world)
    trained, params, bank = perception.trained, perception.params, perception.bank
    posteriors, latent = examine.latent_space(params, perception.held_out, config)
    model = jmvae_shape(config)

    def learn_policy(modality: jax.Array):
        train_key, examine_key = jax.random.split(jax.random.fold_in(dqn_key, modality))
        if config.dqn.observe == "live":
            mdp = observe.live_mdp(config, world, trained, params, model)
        else:
            mdp = observe.bank_mdp(config, bank, params, model)
        state, info = dqn.train(train_key, mdp, modality, config.dqn)
        inputs = modality, state.params, params, perception.held_out, config
        reward = jnp.where(info.episodes > 0, info.episode_return, jnp.nan)
        return state.params, info.loss, reward, *examine.play(examine_key, *inputs)

    # One after the other: compiled once, and no slower than side by side.
    modalities = jnp.arange(len(config.modalities))
    q_networks, losses, reward, totals, firsts = jax.lax.map(learn_policy, modalities)
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
        is_finite=perception.is_finite & jnp.isfinite(losses).all(),
    )


def learn_perception(key: Key, config: Config, world: World) -> Perception:
    """Detectors and the JMVAE; see `learn` for the arguments."""
    num_modalities, model = len(config.modalities), jmvae_shape(config)
    survey_key, jmvae_key, *detector_keys = jax.random.split(key, 2 + num_modalities)
    classes, windows = _survey(survey_key, config, world)
    labels = [jnp.array(config.label_of_class(name)) for name in config.modalities]
    sizes = model.feature_sizes
    found = [
        _train_detector(k, w[0], label[classes[0]], size, config)
        for k, w, label, size in zip(detector_keys, windows, labels, sizes, strict=True)
    ]
    trained = tuple(detector for detector, _ in found)
    detect_each = jax.vmap(jax.vmap(detectors.detect, in_axes=(None, 0)), in_axes=(None, 0))

    def detect(part: int, number: int) -> Bank:
        return tuple(
            _by_class(detect_each(d, w[part]), classes[part], config, number)
            for d, w in zip(trained, windows, strict=True)
        )

    bank = detect(1, config.jmvae.samples_per_class)
    held_out = detect(2, num_held_out_per_class(config))
    params, losses = _train_jmvae(jmvae_key, bank, config)
    is_right = [
        f.argmax(axis=-1) == label[:, None] for f, label in zip(held_out, labels, strict=True)
    ]
    is_finite = [jnp.isfinite(x).all() for x in (losses, *(losses for _, losses in found))]
    return Perception(
        trained=trained,
        params=params,
        bank=bank,
        held_out=held_out,
        windows=tuple(_by_class(w[2], classes[2], config, 1) for w in windows),
        accuracy=jnp.stack([right.mean() for right in is_right]),
        is_finite=jnp.stack(is_finite).all(),
    )


def _survey(
    key: Key, config: Config, world: World
) -> tuple[list[jax.Array], list[list[jax.Array]]]:
    """Looks to train detectors, for the bank, and to measure.

    Returns:
      `[S, N]` classes for each purpose; for each modality `[S, N, F]` windows for each purpose.
    """
    num_pois, num_classes = config.arena.num_pois, len(config.arena.classes)
    looks = (
        config.detector.num_scans,
        config.jmvae.samples_per_class * num_classes,
        num_held_out_per_class(config) * num_classes,
    )
    numbers = [-(-number // num_pois) for number in looks]
    class_key, scene_key = jax.random.split(key)
    class_keys = jax.random.split(class_key, len(numbers))
    classes = [
        observe.balanced_classes(k, config, n) for k, n in zip(class_keys, numbers, strict=True)
    ]
    together = jnp.concatenate(classes)
    _, windows = observe.surveys(jax.random.split(scene_key, len(together)), world, together)
    cuts = [numbers[0], numbers[0] + numbers[1]]
    return classes, [jnp.split(w, cuts) for w in windows]


def _train_detector(
    key: Key, windows: jax.Array, labels: jax.Array, num_labels: int, config: Config
) -> tuple[Detector, jax.Array]:
    """A detector trained on `[S, N, F]` windows, and its `[steps]` losses."""
    settings = config.detector
    init_key, train_key = jax.random.split(key)
    windows, labels = windows.reshape(-1, windows.shape[-1]), labels.reshape(-1)
    detector = detectors.init(init_key, windows, num_labels, settings)
    state = detectors.start(detector, settings)
    inputs = windows, labels, settings, settings.steps
    state, losses = detectors.train(train_key, state, detector, *inputs)
    return dataclasses.replace(detector, params=state.params), losses


def _train_jmvae(key: Key, bank: Bank, config: Config) -> tuple[Params, jax.Array]:
    """The JMVAE with the lowest loss at the end, of several, and the losses of all."""
    settings, model = config.jmvae, jmvae_shape(config)

    def train(key: Key):
        init_key, train_key = jax.random.split(key)
        state = jmvae.start(jmvae.init(init_key, model), settings)
        state, losses = jmvae.train(train_key, state, model, bank, settings, settings.steps)
        return state.params, losses

    params, losses = jax.lax.map(train, jax.random.split(key, settings.restarts))
    best = jnp.argmin(losses[:, -last_steps(settings) :].mean(axis=1))
    return jax.tree.map(lambda x: x[best], params), losses


def _by_class(values: jax.Array, classes: jax.Array, config: Config, number: int) -> jax.Array:
    """`[C, number, ...]` from `[S, N, ...]` looks of at least that many of each class."""
    flat, classes = values.reshape(-1, *values.shape[2:]), classes.reshape(-1)
    each = range(len(config.arena.classes))
    rows = jnp.stack([jnp.nonzero(classes == c, size=number)[0] for c in each])
    return flat[rows]
