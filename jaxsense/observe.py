"""Two ways for the map MDP to look at a point of interest.

`live` casts a scan in the environment's own MJX arena and runs the detector on it; `bank` draws
from stored detections of those scans. Features of single looks have the same distribution; live
looks of one scene share its light.
"""

import chex
import jax
import jax.numpy as jnp

from jaxsense.config import Config, values
from jaxsense.dqn.belief_mdp import MapMdp
from jaxsense.networks import Params
from jaxsense.sim import world as worlds
from jaxsense.types import Belief, Key
from jaxsense.vae import detectors, filtering, fusion
from jaxsense.vae.detectors import Detector
from jaxsense.vae.jmvae import Jmvae

Bank = tuple[jax.Array, ...]
"""`[C, S, D_m]` features of each modality: S detections of every class."""


def live_mdp(
    config: Config,
    world: worlds.World,
    trained: tuple[Detector, ...],
    params: Params,
    model: Jmvae,
) -> MapMdp:
    """The map MDP over live scenes, one MJX arena for each environment."""
    values.require_one_each("trained", trained, model.modalities)

    def new_scene(key: Key, classes: jax.Array):
        return worlds.random_scene(key, world, classes)

    def observe(key: Key, scene, poi: jax.Array, modality: int):
        window, scene = worlds.look(key, world, scene, modality, poi)
        return detectors.detect(trained[modality], window), scene

    return _mdp(config, params, model, new_scene, observe)


def bank_mdp(config: Config, bank: Bank, params: Params, model: Jmvae) -> MapMdp:
    """The map MDP over stored detections; a scene is the `[N]` array of the PoIs' classes."""
    values.require_one_each("bank", bank, model.modalities)
    for features, size in zip(bank, model.feature_sizes, strict=True):
        shape = (len(config.arena.classes), None, size)
        chex.assert_shape(features, shape, custom_message="bank")
        values.require_number("looks at each class in the bank", features.shape[1])
        values.require_finite("bank", features)

    def observe(key: Key, classes: jax.Array, poi: jax.Array, modality: int):
        samples = bank[modality]
        # A key from a split is as random as a draw from it.
        row = jax.random.key_data(key)[-1] % samples.shape[1]
        return samples[classes[poi], row], classes

    return _mdp(config, params, model, lambda key, classes: classes, observe)


def _mdp(config: Config, params: Params, model: Jmvae, new_scene, observe) -> MapMdp:
    def nats(belief: Belief) -> jax.Array:
        return -filtering.entropy(filtering.weights(params[fusion.FILTER], belief))

    rewarded = {"information": nats} if config.mdp.reward == "nats" else {}
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
        **rewarded,
    )


def surveys(
    keys: Key, world: worlds.World, classes: jax.Array, chunk: int = 512
) -> tuple[worlds.Scene, tuple[jax.Array, ...]]:
    """Surveys of many scenes, see `sim.survey`.

    Args:
      keys: `[S]` random keys.
      world: the simulation.
      classes: `[S, N]` int32 classes of the PoIs.
      chunk: number of scenes to simulate side by side.

    Returns:
      `[S]` scenes, and for each modality `[S, N, F]` windows.
    """
    number = len(keys)
    chunk = min(chunk, number)
    # A remainder would compile again.
    rows = jnp.arange(-(-number // chunk) * chunk) % number
    found = jax.lax.map(
        lambda scene: worlds.survey(scene[0], world, scene[1]),
        (keys[rows], classes[rows]),
        batch_size=chunk,
    )
    return jax.tree.map(lambda x: x[:number], found)


def balanced_classes(key: Key, config: Config, number: int) -> jax.Array:
    """`[number, N]` int32 classes in random order, equally frequent up to a remainder."""
    num_pois = config.arena.num_pois
    even = jnp.arange(number * num_pois) % len(config.arena.classes)
    return jax.random.permutation(key, even).reshape(number, num_pois)
