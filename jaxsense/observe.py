"""Two ways for the map MDP to look at a point of interest.

`live` casts a scan in the environment's own MJX arena and runs the detector on it; `bank` draws
from stored detections of those scans. Features of single looks have the same distribution; live
looks of one scene share its light.
"""

import chex
import jax
import jax.numpy as jnp

from jaxsense.config import Config
from jaxsense.core import checks
from jaxsense.core.networks import Params
from jaxsense.core.types import Belief, Key
from jaxsense.dqn.belief_mdp import MapMdp
from jaxsense.dqn.team_mdp import TeamMdp
from jaxsense.sim import world as worlds
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
    checks.require_one_each("trained", trained, model.modalities)

    def new_scene(key: Key, classes: jax.Array):
        return worlds.random_scene(key, world, classes)

    def observe(key: Key, scene, poi: jax.Array, modality: int):
        window, scene = worlds.look(key, world, scene, modality, poi)
        return detectors.detect(trained[modality], window), scene

    return _mdp(config, params, model, new_scene, observe)


def bank_mdp(
    config: Config, bank: Bank, params: Params, model: Jmvae, num_pois: int | None = None
) -> MapMdp:
    """The map MDP over stored detections; a scene is the `[N]` array of the PoIs' classes.

    Args:
      config: all settings.
      bank: the detections.
      params: of the JMVAE, with those of the filter if there is one.
      model: the shape of the JMVAE.
      num_pois: N, by default that of the arena.
    """
    checks.require_one_each("bank", bank, model.modalities)
    for features, size in zip(bank, model.feature_sizes, strict=True):
        shape = (len(config.arena.classes), None, size)
        chex.assert_shape(features, shape, custom_message="bank")
        checks.require_number("looks at each class in the bank", features.shape[1])
        checks.require_finite("bank", features)

    def observe(key: Key, classes: jax.Array, poi: jax.Array, modality: int):
        samples = bank[modality]
        # A key from a split is as random as a draw from it.
        row = jax.random.key_data(key)[-1] % samples.shape[1]
        return samples[classes[poi], row], classes

    return _mdp(config, params, model, lambda key, classes: classes, observe, num_pois)


def team_mdp(config: Config, bank: Bank, params: Params, model: Jmvae) -> TeamMdp:
    """The MDP of a team over stored detections, see `bank_mdp` for the arguments."""
    settings, arena = config.team, config.arena
    num_pois = settings.num_pois[1]

    def new_places(key: Key, number: jax.Array, num_robots: int) -> tuple[jax.Array, jax.Array]:
        """Each PoI at a random place in a cell of its own, robots anywhere."""
        del number
        per_side = settings.cells_per_side
        draws = jax.random.uniform(key, (1 + per_side**2 + 2 * num_pois + 3 * num_robots,))
        side = settings.sides[0] + (settings.sides[1] - settings.sides[0]) * draws[0]
        order, draws = draws[1 : 1 + per_side**2], draws[1 + per_side**2 :]
        cell = jnp.argsort(order)[:num_pois]
        corner = jnp.stack([cell // per_side, cell % per_side], axis=-1)
        play = jnp.maximum(side / per_side - arena.poi_pitch, 0.0)
        jitter = play * (draws[: 2 * num_pois].reshape(num_pois, 2) - 0.5)
        positions = (corner + 0.5) * side / per_side - side / 2 + jitter
        places = 2 * draws[2 * num_pois :].reshape(num_robots, 3) - 1
        reach = side / 2 - config.navigation.robot_radius
        poses = jnp.concatenate([reach * places[:, :2], jnp.pi * places[:, 2:]], axis=-1)
        return positions, poses

    mapped = bank_mdp(config, bank, params, model, num_pois)
    return TeamMdp(settings, mapped, new_places, config.modalities)


def _mdp(
    config: Config,
    params: Params,
    model: Jmvae,
    new_scene,
    observe,
    num_pois: int | None = None,
) -> MapMdp:
    def nats(belief: Belief) -> jax.Array:
        return -filtering.entropy(filtering.weights(params[fusion.FILTER], belief))

    rewarded = {"information": nats} if config.mdp.reward == "nats" else {}
    return MapMdp(
        config=config.mdp,
        num_pois=num_pois or config.arena.num_pois,
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
