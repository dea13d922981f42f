"""The two ways in which the map MDP looks at a point of interest.

`live` casts a scan in the environment's own MJX arena and runs the detector on it; `bank` draws
from stored detections of such scans. Their features have the same distribution.
"""

import chex
import jax
import jax.numpy as jnp

from jaxsense.config import Config
from jaxsense.dqn.belief_mdp import MapMdp
from jaxsense.sim import world as worlds
from jaxsense.training import Params
from jaxsense.types import Key
from jaxsense.vae import detectors, fusion
from jaxsense.vae.detectors import Detector
from jaxsense.vae.jmvae import Jmvae

Bank = tuple[jax.Array, ...]
"""For each modality `[C, S, D_m]` features of S detections of every class."""


def live_mdp(
    config: Config,
    world: worlds.World,
    trained: tuple[Detector, ...],
    params: Params,
    model: Jmvae,
) -> MapMdp:
    """The map MDP over scenes of their own, one MJX arena for each environment."""

    def new_scene(key: Key, classes: jax.Array):
        return worlds.random_scene(key, world, classes)

    def observe(key: Key, scene, poi: jax.Array, modality: int):
        window, scene = worlds.look(key, world, scene, modality, poi)
        return detectors.detect(trained[modality], window), scene

    return _mdp(config, params, model, new_scene, observe)


def bank_mdp(config: Config, bank: Bank, params: Params, model: Jmvae) -> MapMdp:
    """The map MDP over stored detections; a scene is the `[N]` array of the PoIs' classes."""
    for features, size in zip(bank, model.feature_sizes, strict=True):
        shape = (len(config.arena.classes), None, size)
        chex.assert_shape(features, shape, custom_message="bank")

    def observe(key: Key, classes: jax.Array, poi: jax.Array, modality: int):
        samples = bank[modality]
        row = jax.random.randint(key, (), 0, samples.shape[1])
        return samples[classes[poi], row], classes

    return _mdp(config, params, model, lambda key, classes: classes, observe)


def _mdp(config: Config, params: Params, model: Jmvae, new_scene, observe) -> MapMdp:
    return MapMdp(
        config=config.mdp,
        num_pois=config.arena.num_pois,
        num_classes=len(config.arena.classes),
        num_modalities=len(config.modalities),
        unseen=fusion.unseen(model, config.mdp.unseen_variance),
        new_scene=new_scene,
        observe=observe,
        write=lambda belief, seen, features, modality: fusion.write(
            params, model, belief, seen, features, modality
        ),
    )


def first_looks(
    key: Key, world: worlds.World, modality: int, per_class: int, chunk: int = 1536
) -> jax.Array:
    """Looks at PoIs of every class, each in a scene of its own.

    Args:
      key: random key.
      world: the simulation.
      modality: index of the sensor; static.
      per_class: how many of each class, S.
      chunk: how many are simulated side by side.

    Returns:
      `[C, S, F]` windows.
    """
    num_classes = len(world.config.arena.classes)
    chunk = min(chunk, num_classes * per_class)
    num_chunks = -(-num_classes * per_class // chunk)
    classes = jnp.arange(num_chunks * chunk) % num_classes
    keys = jax.random.split(key, (num_chunks, chunk))
    windows = jax.lax.map(
        jax.vmap(lambda inputs: worlds.first_look(inputs[0], world, modality, inputs[1])),
        (keys, classes.reshape(num_chunks, chunk)),
    )
    windows = windows.reshape(num_chunks * chunk, -1)[: num_classes * per_class]
    return windows.reshape(per_class, num_classes, -1).swapaxes(0, 1)
