"""How robots look at points of interest, and the MDPs of these looks.

`Live` casts a scan in the environment's own MJX arena and runs the detector on it; `Bank` draws
from stored features of such scans. Features of single looks have the same distribution; live looks
of one scene share its light.
"""

import chex
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsense.config import Config
from jaxsense.core import checks
from jaxsense.core.types import Key, Samples, pytree
from jaxsense.dqn import rewards
from jaxsense.dqn.map_mdp import Looks, MapMdp
from jaxsense.dqn.team_mdp import Places, TeamMdp
from jaxsense.models import Models
from jaxsense.sim import windows as windowing
from jaxsense.sim import world as worlds
from jaxsense.sim.sensors import Sensor
from jaxsense.sim.world import Scene, World
from jaxsense.vae import detectors
from jaxsense.vae.detectors import Detector

_SCENES_AT_ONCE = 512


@pytree
class Live:
    """Looks at scenes of the simulation, each with its own MJX arena.

    Attributes:
      world: the simulation.
      detectors: one for each modality.
    """

    world: World
    detectors: tuple[Detector, ...]

    @property
    def num_modalities(self) -> int:
        """M."""
        return len(self.detectors)

    def scene(self, key: Key, classes: jax.Array) -> Scene:
        """A random scene with PoIs of the given classes.

        Args:
          key: random key.
          classes: `[N]` int32.
        """
        return worlds.random_scene(key, self.world, classes)

    def observe(
        self, key: Key, scene: Scene, poi: jax.Array, modality: int
    ) -> tuple[jax.Array, Scene]:
        """Puts a robot at a random viewpoint of a PoI and scans, see `Looks.observe`.

        Args:
          key: random key.
          scene: the current scene.
          poi: `[]` int32.
          modality: index of the sensor; static.
        """
        window, scene = worlds.look(key, self.world, scene, modality, poi)
        return detectors.detect(self.detectors[modality], window), scene


@pytree
class Bank:
    """Looks that draw from stored features; a scene is the `[N]` array of the PoIs' classes.

    Attributes:
      features: for each modality `[C, S, D_m]`, S looks at every class.
    """

    features: Samples

    @property
    def num_modalities(self) -> int:
        """M."""
        return len(self.features)

    def scene(self, key: Key, classes: jax.Array) -> jax.Array:
        """The `classes` themselves; the `key` is not used."""
        del key
        return classes

    def observe(
        self, key: Key, scene: jax.Array, poi: jax.Array, modality: int
    ) -> tuple[jax.Array, jax.Array]:
        """Draws a look at the PoI's class, see `Looks.observe`.

        Args:
          key: random key.
          scene: `[N]` int32 classes.
          poi: `[]` int32.
          modality: index of the sensor; static.
        """
        samples = self.features[modality]
        # A key from a split is as random as a draw from it.
        row = jax.random.key_data(key)[-1] % samples.shape[1]
        return samples[scene[poi], row], scene


def features_of(
    detector: Detector, sensor: Sensor, readings: Float[Array, "W ..."]
) -> Float[Array, " L"]:
    """What a detector makes of the rays that it reads.

    Args:
      detector: of the sensor.
      sensor: the sensor.
      readings: `[window, ...]` of the rays around the PoI's bearing.

    Returns:
      `[D_m]` probabilities of the labels.
    """
    return detectors.detect(detector, windowing.as_window(sensor, readings))


def make_mdp(config: Config, models: Models, looks: Looks | None = None) -> MapMdp | TeamMdp:
    """The MDP of `config.dqn.task`: of one agent with the map, or of a team.

    Args:
      config: all settings.
      models: from `jaxsense.load` or `jaxsense.init`.
      looks: how it looks at PoIs, for example `Bank(jaxsense.detections(...))`; by default every
        look casts a scan in the environment's own arena.

    Raises:
      ValueError: if models or looks have other shapes than the settings ask for.
    """
    if not isinstance(models, Models):
        raise ValueError(f"models = {type(models).__name__}: must be Models, as from jaxsense.load")
    expected = len(config.arena.classes), config.jmvae.latent_size
    found = models.fusion.classes.mean.shape
    if found != expected:
        reason = f"holds {found[0]} classes in {found[1]} dimensions; must be"
        raise ValueError(f"models.fusion {reason} {expected}, as config's; take both from one run")
    looks = Live(worlds.make_world(config), models.detectors) if looks is None else looks
    _require_fitting(config, looks)
    settings = config.team
    places = Places(
        sides=settings.sides,
        robot_radius=config.navigation.robot_radius,
        poi_pitch=config.arena.poi_pitch,
        num_pois=settings.num_pois[1],
        cells_per_side=settings.cells_per_side,
    )

    def of_number(num_pois: int) -> MapMdp:
        return MapMdp(looks, models.fusion, rewards.make(config.mdp), config.mdp, num_pois)

    return models.agent.mdp(of_number, places, config.modalities)


def _require_fitting(config: Config, looks: Looks) -> None:
    """Raises `ValueError` unless looks of this package have the shapes of the settings."""
    if isinstance(looks, Bank):
        checks.require_one_each("looks", looks.features, config.modalities)
        for name, features in zip(config.modalities, looks.features, strict=True):
            shape = len(config.arena.classes), None, len(config.labels(name))
            chex.assert_shape(features, shape, custom_message=f"looks of {name}")
            checks.require_number("looks at each class", features.shape[1])
            checks.require_finite("looks", features)
    if isinstance(looks, Live):
        checks.require_one_each("detectors", looks.detectors, config.modalities)
        for sensor, detector in zip(looks.world.sensors, looks.detectors, strict=True):
            size, found = sensor.window * sensor.channels, detector.offset.size
            if found != size:
                reason = f"reads windows of {found} numbers; must be of {size}, as config's are"
                raise ValueError(f"models.detectors of {sensor.name}: {reason}")


def surveys(keys: Key, world: World, classes: jax.Array) -> tuple[Scene, tuple[jax.Array, ...]]:
    """Surveys of many scenes, see `sim.survey`.

    Args:
      keys: `[S]` random keys.
      world: the simulation.
      classes: `[S, N]` int32 classes of the PoIs.

    Returns:
      `[S]` scenes, and for each modality `[S, N, F]` windows.
    """
    number = len(keys)
    chunk = min(_SCENES_AT_ONCE, number)
    # A remainder would compile again.
    rows = jnp.arange(-(-number // chunk) * chunk) % number
    found = jax.lax.map(
        lambda scene: worlds.survey(scene[0], world, scene[1]),
        (keys[rows], classes[rows]),
        batch_size=chunk,
    )
    return jax.tree.map(lambda x: x[:number], found)


def detect_all(trained: tuple[Detector, ...], windows: tuple[jax.Array, ...]) -> Samples:
    """Features of surveyed scans.

    Args:
      trained: one detector for each modality.
      windows: for each modality `[S, N, F]`.

    Returns:
      For each modality `[S, N, D_m]`.
    """
    detect = jax.vmap(jax.vmap(detectors.detect, (None, 0)), (None, 0))
    return tuple(detect(d, w) for d, w in zip(trained, windows, strict=True))


def balanced_classes(key: Key, config: Config, number: int) -> jax.Array:
    """Classes of scenes in random order, equally frequent up to a remainder.

    Args:
      key: random key.
      config: all settings.
      number: of scenes; static.

    Returns:
      `[number, N]` int32.
    """
    num_pois = config.arena.num_pois
    even = jnp.arange(number * num_pois) % len(config.arena.classes)
    return jax.random.permutation(key, even).reshape(number, num_pois)


def by_class(values: jax.Array, classes: jax.Array, num_classes: int, number: int) -> jax.Array:
    """Sorts looks by class.

    Args:
      values: `[S, N, ...]` with at least `number` of each class.
      classes: `[S, N]` int32.
      num_classes: C; static.
      number: looks to keep of each class; static.

    Returns:
      `[C, number, ...]`.
    """
    flat, classes = values.reshape(-1, *values.shape[2:]), classes.reshape(-1)
    rows = [jnp.nonzero(classes == c, size=number)[0] for c in range(num_classes)]
    return flat[jnp.stack(rows)]


def detections(key: Key, config: Config, models: Models, samples: int) -> Samples:
    """Features of simulated looks at every class, for a `Bank`.

    Args:
      key: random key.
      config: the settings.
      models: the models.
      samples: looks at each class by each sensor, S.

    Returns:
      For each modality `[C, S, D_m]`.

    Raises:
      ValueError: if `samples` is not positive.
    """
    checks.require_number("samples", samples)
    num_classes = len(config.arena.classes)
    world = worlds.make_world(config)
    number = -(-samples * num_classes // config.arena.num_pois)

    @jax.jit
    def look(key: Key) -> Samples:
        class_key, survey_key = jax.random.split(key)
        classes = balanced_classes(class_key, config, number)
        _, seen = surveys(jax.random.split(survey_key, number), world, classes)
        features = detect_all(models.detectors, seen)
        return tuple(by_class(x, classes, num_classes, samples) for x in features)

    return look(key)
