"""How robots look at points of interest, and the MDPs of these looks.

`Live` casts a scan in the environment's own MJX arena and runs the detector on it; `Bank` draws
from stored features of such scans. Single looks have the same distribution in both; live looks at
one scene share its light, which drifts over positions.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int, Shaped

from jaxsense.config import Config
from jaxsense.core import checks
from jaxsense.core.types import Fusion, Index, Key, Samples, pytree
from jaxsense.dqn import rewards
from jaxsense.dqn.mdp import LookSource, Mdp
from jaxsense.dqn.team import Places, Teams
from jaxsense.models import Models, make_travel, require_fitting
from jaxsense.sim import world as worlds
from jaxsense.sim.windows import make_domain
from jaxsense.sim.world import Scene, World
from jaxsense.vae import detectors
from jaxsense.vae.detectors import Detector

ROBOTS_EACH = 2
"""Robots of each modality in a random team, at most."""
_SCENES_AT_ONCE = 512
_ROUNDING = 1e-5
_MOST_CHOICES = 300  # in an episode of a team
_AS_FAR = 16  # one in so many looks at a class counts as from about as far
_FAR_APART = 1e3  # m, beyond all distances
_FARTHEST_MOVE = 1.0  # m, about as far as a robot that looks again drives


@pytree
class Live:
    """Simulates every look, with one MJX arena for each environment."""

    world: World
    detectors: tuple[Detector, ...]

    @property
    def num_modalities(self) -> int:
        """M."""
        return len(self.detectors)

    def scene(self, key: Key, classes: Int[Array, " N"]) -> Scene:
        """Random scene with PoIs of the given classes."""
        return worlds.random_scene(key, self.world, classes)

    def observe(
        self,
        key: Key,
        scene: Scene,
        poi: Int[Array, ""],
        modality: int,
        distance: Float[Array, ""] | float = 0.0,
    ) -> tuple[Float[Array, " D_m"], Scene]:
        """Puts a robot at a random viewpoint of a PoI and scans, at whatever distance."""
        del distance
        look, scene = worlds.look(key, self.world, scene, modality, poi)
        return detectors.features(self.detectors[modality], *look), scene


@pytree
class Bank:
    """Draws looks from stored features; a scene holds only the classes of the PoIs.

    Attributes:
      distances: for each modality `[C, S]` metres from which the looks are, in rising order of each
        class, see `by_distance`; None if any look stands for any distance.
    """

    features: Samples
    distances: tuple[Float[Array, "C S"], ...] | None = None

    @property
    def num_modalities(self) -> int:
        """M."""
        return len(self.features)

    def scene(self, key: Key, classes: Int[Array, " N"]) -> Int[Array, " N"]:
        """The classes."""
        del key
        return classes

    def observe(
        self,
        key: Key,
        scene: Int[Array, " N"],
        poi: Int[Array, ""],
        modality: int,
        distance: Float[Array, ""] | float = 0.0,
    ) -> tuple[Float[Array, " D_m"], Int[Array, " N"]]:
        """Draws a look at the PoI's class from about as far, see `LookSource.observe`."""
        samples, which = self.features[modality], scene[poi]
        # A key from a split is as random as a draw from it.
        draw, number = jax.random.key_data(key)[-1], samples.shape[1]
        row = draw % number
        if self.distances is not None:
            near = -(-number // _AS_FAR)
            far = self.distances[modality]
            # One search through all classes: in a batch, each of a class would copy its distances.
            order = (far + _FAR_APART * jnp.arange(len(far))[:, None]).ravel()
            rank = jnp.searchsorted(order, distance + _FAR_APART * which) - which * number
            first = jnp.clip(rank - near // 2, 0, number - near)
            row = jnp.where(jnp.asarray(distance) > 0, first + draw % near, row)
        return samples[which, row], scene


def by_distance(features: Samples, distances: tuple[Float[Array, "C S"], ...]) -> Bank:
    """A bank whose looks depend on the distance."""
    ranked = [
        x[jnp.arange(len(x))[:, None], jnp.argsort(far, axis=1)]
        for x, far in zip(features, distances, strict=True)
    ]
    return Bank(tuple(ranked), tuple(jnp.sort(far, axis=1) for far in distances))


def make_mdp(config: Config, models: Models, looks: LookSource | None = None) -> Mdp:
    """Makes the MDP of `config.dqn.task`: of one robot with the first sensor, or of random teams.

    `Mdp.of` gives the robot another sensor.

    Args:
      models: from `jaxsense.load` or `jaxsense.init`.
      looks: how to look at PoIs, for example `Bank(jaxsense.detections(...))`, which a team needs;
        `Live` by default, so that every look casts a scan in the environment's own arena.

    Raises:
      ValueError: if the shapes of `models` or `looks` do not match `config`, `models.fusion` is no
        `Fusion`, or looks are `Live` of a team or outside the detectors' `sim.windows.Domain`.
    """
    require_fitting(config, models)
    looks = Live(worlds.make_world(config), models.detectors) if looks is None else looks
    _require_fitting(config, models, looks)
    mdp = mdp_of_one(config, models.fusion, looks, 0)
    if config.dqn.task == "map":
        return mdp
    settings = config.team
    if isinstance(looks, Live):
        reason = "must be a Bank with dqn.task = 'team', whose MDP has no scans"
        raise ValueError(f"looks = Live: {reason}")
    return dataclasses.replace(
        mdp,
        config=dataclasses.replace(config.mdp, max_steps=_MOST_CHOICES),
        num_pois=settings.num_pois[1],
        robots=jnp.repeat(jnp.arange(len(config.modalities)), ROBOTS_EACH),
        teams=Teams(
            settings,
            make_travel(config),
            Places(settings, config.arena.poi_pitch),
            config.modalities,
            novelty=models.novelty if config.detector.num_repeats else None,
        ),
    )


def beyond_training(config: Config) -> list[str]:
    """What missions ask of the Q-network of a team that it does not learn with; a line each."""
    if config.dqn.task == "map":
        return []
    found = {
        f"{config.arena.num_pois} PoIs": (config.arena.num_pois, config.team.num_pois),
        f"an arena of {config.arena.side:g} m": (config.arena.side, config.team.sides),
    }
    for name, number in ((name, config.carried.count(name)) for name in config.modalities):
        found[f"{number} robots with {name}"] = number, (1, ROBOTS_EACH)
    return [
        f"{what}: the Q-network learns with {least:g} to {most:g}"
        for what, (number, (least, most)) in found.items()
        if not least <= number <= most
    ]


def mdp_of_one(
    config: Config, fusion: Fusion, looks: LookSource, modality: Index, num_pois: int | None = None
) -> Mdp:
    """The MDP of one robot without travel, with as many PoIs as in the arena by default."""
    number = config.arena.num_pois if num_pois is None else num_pois
    return Mdp(looks, fusion, rewards.make(config.mdp), config.mdp, number, (modality,))


def _require_fitting(config: Config, models: Models, looks: LookSource) -> None:
    """Raises `ValueError` if looks of this package match neither the settings nor the models."""
    if isinstance(looks, Bank):
        checks.require_one_each("looks", looks.features, config.modalities)
        for name, features in zip(config.modalities, looks.features, strict=True):
            shape = len(config.arena.classes), None, len(config.labels(name))
            checks.require_shape(f"looks of {name}", features, shape)
            checks.require_number("looks at each class", features.shape[1])
            checks.require_finite("looks", features)
    if isinstance(looks, Live):
        for sensor, detector in zip(looks.world.sensors, looks.detectors, strict=True):
            size, found = sensor.window * sensor.channels, detector.window_size
            if found != size:
                reason = f"reads windows of {found} numbers; must be of {size}, as config's are"
                raise ValueError(f"models.detectors of {sensor.name}: {reason}")
        _require_learned(config, looks.world, models)


def _require_learned(config: Config, world: World, models: Models) -> None:
    """Raises `ValueError` if looks are not within the domains of the models' detectors."""
    config = dataclasses.replace(config, viewpoint=world.viewpoint)
    for sensor, learned in zip(world.sensors, models.domains, strict=True):
        for name, found in vars(make_domain(config, sensor)).items():
            limits = getattr(learned, name)
            if isinstance(limits, Tracer):
                continue
            least, most = limits.tolist()
            is_learned = lambda x, of=limits: np.abs(x - np.clip(x, *of)) < _ROUNDING  # noqa: E731
            expected = f"must be from {least:.3g} to {most:.3g}, as its detector has learned"
            checks.require(f"{name} of looks by the {sensor.name}", found, is_learned, expected)


def surveys(
    keys: Key,
    world: World,
    classes: Int[Array, "S N"],
    is_empty: Bool[Array, " S"],
    places: Key | None = None,
) -> tuple[tuple[Float[Array, "S N _"], ...], Float[Array, "S M N"]]:
    """Surveys many scenes, see `sim.world.survey`.

    Returns:
      For each modality the windows of all PoIs, and their expected distances.
    """
    number = len(keys)
    chunk = min(_SCENES_AT_ONCE, number)
    # A remainder would be compiled separately.
    rows = jnp.arange(-(-number // chunk) * chunk) % number
    found = jax.lax.map(
        lambda scene: worlds.survey(scene[0], world, *scene[1:]),
        jax.tree.map(lambda x: x[rows], (keys, classes, is_empty, places)),
        batch_size=chunk,
    )
    return jax.tree.map(lambda x: x[:number], found)


def repeats(
    keys: Key,
    world: World,
    classes: Int[Array, "S N"],
    modality: int,
    number: int,
    places: Key | None = None,
) -> tuple[Float[Array, "S T F"], Float[Array, "S T"], Float[Array, "S T 2"]]:
    """Looks T times at the first PoI of many scenes, from near the first look.

    In half of the scenes all looks are from one place, in the others up to 1 m away from it.

    Returns:
      Windows, expected distances, and positions of the robot.
    """

    def look(scene: tuple[Key, jax.Array, Key | None]) -> tuple[jax.Array, jax.Array, jax.Array]:
        key, classes, places = scene
        scene_key, move_key, first_key, *later_keys = jax.random.split(key, 2 + number)
        farthest = jnp.where(jax.random.bernoulli(move_key), _FARTHEST_MOVE, 0.0)
        drawn, poi = worlds.random_scene(scene_key, world, classes, places), jnp.int32(0)
        first, seen = worlds.look(first_key, world, drawn, modality, poi)

        def again(key: Key) -> tuple[jax.Array, jax.Array, jax.Array]:
            found, moved = worlds.look(key, world, seen, modality, poi, farthest)
            return *found, moved.poses[modality, :2]

        first = (*first, seen.poses[modality, :2])
        later = jax.vmap(again)(jnp.stack(later_keys))
        return jax.tree.map(lambda x, y: jnp.concatenate([x[None], y]), first, later)

    batch = min(_SCENES_AT_ONCE, len(keys))
    return jax.lax.map(look, (keys, classes, places), batch_size=batch)


def features(
    trained: tuple[Detector, ...],
    windows: tuple[Float[Array, "S N _"], ...],
    distances: Float[Array, "S M N"],
) -> tuple[Float[Array, "S N D_m"], ...]:
    """Features of surveyed scenes, for each modality."""
    of_looks = jax.vmap(detectors.features, (None, 0, 0))
    scenes, batch = (windows, distances), min(_SCENES_AT_ONCE, len(distances))
    return jax.lax.map(lambda seen: tuple(map(of_looks, trained, *seen)), scenes, batch_size=batch)


def balanced_classes(key: Key, config: Config, number: int) -> Int[Array, "{number} N"]:
    """Classes for a number of scenes, in random order and equally frequent up to a remainder."""
    num_pois = config.arena.num_pois
    even = jnp.arange(number * num_pois) % len(config.arena.classes)
    return jax.random.permutation(key, even).reshape(number, num_pois)


def by_class(
    values: Shaped[Array, "S N *F"], classes: Int[Array, "S N"], num_classes: int, number: int
) -> Shaped[Array, "{num_classes} {number} *F"]:
    """Sorts looks by class; those of a class with fewer than `number` are taken again.

    Each class must occur.
    """
    flat, classes = values.reshape(-1, *values.shape[2:]), classes.reshape(-1)

    def rows_of(c: int) -> jax.Array:
        found = jnp.nonzero(classes == c, size=number)[0]
        # If there are fewer, from the first again.
        return found[jnp.arange(number) % jnp.maximum(jnp.sum(classes == c), 1)]

    return flat[jnp.stack([rows_of(c) for c in range(num_classes)])]


@checks.typed
def detections(key: Key, config: Config, models: Models, samples: int) -> Samples:
    """Features of simulated looks at every class, for a `Bank`.

    Args:
      samples: S, looks at each class by each sensor.

    Raises:
      ValueError: if `samples` is not positive, or looks lie outside the detectors' domains.
    """
    return _simulated(key, config, models, samples)[0]


@checks.typed
def bank(key: Key, config: Config, models: Models, samples: int) -> Bank:
    """Simulated looks by distance, from which robots that travel learn; see `detections`."""
    return by_distance(*_simulated(key, config, models, samples))


def _simulated(
    key: Key, config: Config, models: Models, samples: int
) -> tuple[Samples, tuple[Float[Array, "C S"], ...]]:
    """Features of looks, and metres from which they are."""
    checks.require_number("samples", samples)
    num_classes = len(config.arena.classes)
    world = worlds.make_world(config)
    _require_learned(config, world, models)
    number = -(-samples * num_classes // config.arena.num_pois)

    @jax.jit
    def look(key: Key, world: World, models: Models) -> tuple[Samples, Samples]:
        class_key, survey_key = jax.random.split(key)
        classes = balanced_classes(class_key, config, number)
        keys, is_empty = jax.random.split(survey_key, number), jnp.zeros(number, bool)
        seen, distances = surveys(keys, world, classes, is_empty)
        found = features(models.detectors, seen, distances), tuple(jnp.swapaxes(distances, 0, 1))
        sort = lambda x: by_class(x, classes, num_classes, samples)  # noqa: E731
        return jax.tree.map(sort, found)

    return look(key, world, models)
