"""Detectors and a JMVAE that were really trained, in as little time as will do."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.maps import Examiner, Task
from jaxsense import observe
from jaxsense.config import MODALITIES, PRESETS, Config, DetectorConfig, DqnConfig, JmvaeConfig
from jaxsense.models import jmvae_shape
from jaxsense.networks import Params
from jaxsense.observe import Bank
from jaxsense.sim import world as worlds
from jaxsense.types import Key
from jaxsense.vae import detectors, jmvae

_CONFIG = dataclasses.replace(
    PRESETS["default"],
    detector=DetectorConfig(num_scans=24576, steps=1500, batch=256),
    jmvae=JmvaeConfig(samples_per_class=4096, steps=2000),
    dqn=DqnConfig(
        observe="bank",
        epochs=400,
        chunk=20,
        updates=8,
        batch=256,
        replay_capacity=65536,
        epsilon_decay=0.98,
        target_period=10,
    ),
)
_QUICK = dataclasses.replace(
    PRESETS["smoke"],
    detector=DetectorConfig(num_scans=384, steps=20, batch=32),
    jmvae=JmvaeConfig(restarts=1, samples_per_class=64, steps=20, batch=32),
)


@functools.cache
def trained_task(quick: bool) -> tuple[Task, Examiner]:
    """The map MDP on detections of trained detectors, once for all rows, and its examination.

    The examination has detections of its own.
    """
    config = _QUICK if quick else _CONFIG
    detector_key, jmvae_key = jax.random.split(jax.random.key(6))
    bank, held_out = _train_detectors(detector_key, config)
    params = _train_jmvae(jmvae_key, bank, config)
    return Task(config, params, bank), Examiner(
        Task(config, params, held_out), 32 if quick else 4096
    )


def _train_detectors(key: Key, config: Config) -> tuple[Bank, Bank]:
    """Two banks of detections of looks that the detectors were not trained on."""
    world = worlds.make_world(config)
    settings, num_pois = config.detector, config.arena.num_pois
    num_train = settings.num_scans // num_pois
    num_bank = config.jmvae.samples_per_class * len(config.arena.classes) // num_pois
    class_key, scene_key, *keys = jax.random.split(key, 2 + len(config.modalities))
    class_keys = jax.random.split(class_key, 3)
    classes = jnp.concatenate(
        [
            observe.balanced_classes(k, config, number)
            for k, number in zip(class_keys, (num_train, num_bank, num_bank), strict=True)
        ]
    )
    survey = jax.jit(lambda keys, classes: observe.surveys(keys, world, classes)[1])
    windows = survey(jax.random.split(scene_key, len(classes)), classes)

    @functools.partial(jax.jit, static_argnames=("num_labels",))
    def train_and_detect(key, windows, labels, num_labels: int) -> jax.Array:
        init_key, train_key = jax.random.split(key)
        shown = windows[:num_train].reshape(-1, windows.shape[-1])
        detector = detectors.init(init_key, shown, num_labels, settings)
        state = detectors.start(detector, settings)
        inputs = shown, labels[:num_train].reshape(-1), settings, settings.steps
        state, _ = detectors.train(train_key, state, detector, *inputs)
        detector = dataclasses.replace(detector, params=state.params)
        return jax.vmap(jax.vmap(lambda w: detectors.detect(detector, w)))(windows[num_train:])

    banks: tuple[list[jax.Array], list[jax.Array]] = ([], [])
    of_looks = np.asarray(classes[num_train:])
    for modality_key, name, seen in zip(keys, config.modalities, windows, strict=True):
        attribute = MODALITIES[name]
        labels = jnp.array(config.arena.label_of_class(attribute))[classes]
        num_labels = len(config.arena.labels(attribute))
        features = np.asarray(train_and_detect(modality_key, seen, labels, num_labels))
        for bank, part in zip(banks, (slice(num_bank), slice(num_bank, None)), strict=True):
            bank.append(_by_class(features[part], of_looks[part], config))
    return tuple(banks[0]), tuple(banks[1])


def _by_class(features: np.ndarray, classes: np.ndarray, config: Config) -> jax.Array:
    """`[C, S, D_m]` from `[..., D_m]` features of equally many looks at each class."""
    number = config.jmvae.samples_per_class
    each = range(len(config.arena.classes))
    return jnp.stack([jnp.asarray(features[classes == c][:number]) for c in each])


def _train_jmvae(key: Key, bank: Bank, config: Config) -> Params:
    """The parameters with the lowest loss at the end of several trainings."""
    settings, model = config.jmvae, jmvae_shape(config)

    def train(key: Key):
        init_key, train_key = jax.random.split(key)
        state = jmvae.start(jmvae.init(init_key, model), settings)
        state, losses = jmvae.train(train_key, state, model, bank, settings, settings.steps)
        return state.params, losses[-100:].mean()

    params, losses = jax.jit(jax.vmap(train))(jax.random.split(key, settings.restarts))
    return jax.tree.map(lambda x: x[jnp.argmin(losses)], params)
