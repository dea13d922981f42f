"""Looks at points of interest in simulated arenas: the simulator's interface for training."""

import dataclasses
import functools

import chex
import jax
import jax.numpy as jnp
from mujoco import mjx

from jaxsense.config import Config
from jaxsense.core import checks
from jaxsense.core.types import Key, others, pytree
from jaxsense.sim import arena as arenas
from jaxsense.sim import sensors, viewpoints


@dataclasses.dataclass(frozen=True, eq=False)
class World:
    """The parts of a simulation that all scenes share. Static under `jit`.

    Attributes:
      config: all settings.
      arena: the compiled arena.
      sensors: the sensor of each modality; in a training robot m carries the m-th.
    """

    config: Config
    arena: arenas.Arena
    sensors: tuple[sensors.Sensor, ...]


@pytree
class Scene:
    """One arena at one moment, the source of its MJX state.

    Attributes:
      layout: the PoIs.
      light: the light.
      poses: `[R, 3]` x [m], y [m] and yaw [rad] of each robot.
    """

    layout: arenas.Layout
    light: sensors.Light
    poses: jax.Array


def make_world(
    config: Config, robots: tuple[str, ...] | None = None, *, contacts: bool = False
) -> World:
    """Compiles the arena that `config` describes.

    Args:
      config: all settings.
      robots: the modality of each robot; by default one robot for each of `config.modalities`, as a
        training needs.
      contacts: see `arena.build`.
    """
    carries_lidar = tuple(name == "lidar" for name in robots or config.modalities)
    arena = arenas.build(config.arena, carries_lidar, contacts=contacts)
    return World(config, arena, sensors.make(config))


def with_config(world: World, config: Config) -> World:
    """Replaces a simulation's numbers, which may be traced; the arena stays the same."""
    return dataclasses.replace(world, config=config, sensors=sensors.make(config))


def random_scene(key: Key, world: World, classes: jax.Array) -> Scene:
    """Draws a scene with PoIs of the given classes at random places under random light.

    Args:
      key: random key.
      world: the simulation.
      classes: `[N]` int32 index into `config.arena.classes`.

    Returns:
      The scene. Every robot stands at a random viewpoint of a random PoI.
    """
    layout_key, light_key, poi_key, *robot_keys = jax.random.split(key, 3 + len(world.sensors))
    layout = arenas.random_layout(layout_key, world.config.arena, classes)
    pois = jax.random.randint(poi_key, (len(robot_keys),), 0, world.config.arena.num_pois)
    poses = jnp.zeros((0, 3))
    for robot_key, poi in zip(robot_keys, pois, strict=True):
        pose, _ = _viewpoint(robot_key, world, layout, poses, poi)
        poses = jnp.concatenate([poses, pose[None]])
    return Scene(layout, sensors.random_light(light_key), poses)


def look(
    key: Key, world: World, scene: Scene, robot: int, poi: jax.Array
) -> tuple[jax.Array, Scene]:
    """Puts a robot at a random viewpoint of a PoI, updates MJX's kinematics and scans.

    Casts only the rays that the detector reads; their readings are those of a full scan.

    Args:
      key: random key.
      world: the simulation.
      scene: the current scene.
      robot: index of the robot and of its modality; static.
      poi: `[]` int32 index of the PoI.

    Returns:
      `[F]` the detector's input, and the scene with the robot at its viewpoint.
    """
    if not 0 <= robot < len(world.sensors):
        raise ValueError(f"robot = {robot}: must be one of the {len(world.sensors)} robots")
    chex.assert_rank(poi, 0, custom_message="poi")
    checks.require_index("poi", poi, world.config.arena.num_pois)
    checks.require_finite("scene.poses", scene.poses)
    viewpoint_key, noise_key = jax.random.split(key)
    others = jnp.delete(scene.poses, robot, axis=0)
    pose, bearing = _viewpoint(viewpoint_key, world, scene.layout, others, poi)
    scene = dataclasses.replace(scene, poses=scene.poses.at[robot].set(pose))
    data = arenas.place(world.arena, scene.layout, scene.poses)
    readings = scan_around(noise_key, world, scene, data, robot, bearing)
    return sensors.as_window(world.sensors[robot], readings), scene


def scan_around(
    key: Key,
    world: World,
    scene: Scene,
    data: mjx.Data,
    robot: int,
    bearing: jax.Array,
    modality: int | None = None,
) -> jax.Array:
    """Readings of a robot's sensor around a bearing from its current place.

    Args:
      key: random key of the noise.
      world: the simulation.
      scene: the scene.
      data: the MJX state of the scene, from `place`.
      robot: index of the robot; static.
      bearing: `[]` in the robot's frame, in radians.
      modality: index of the robot's sensor; static, by default that of the robot.

    Returns:
      `[window, ...]` readings of the rays that the detector reads.
    """
    sensor = world.sensors[robot if modality is None else modality]
    rays = sensors.window_of(sensor, sensor.directions, bearing)
    return sensors.scan(key, sensor, world.arena, data, scene.layout, scene.light, robot, rays)


def survey(key: Key, world: World, classes: jax.Array) -> tuple[Scene, tuple[jax.Array, ...]]:
    """Draws a scene, and scans each PoI in it by each robot.

    Args:
      key: random key.
      world: the simulation.
      classes: `[N]` int32 index into `config.arena.classes`.

    Returns:
      The scene, and for each robot the `[N, F]` inputs of its detector.
    """
    scene_key, viewpoint_key, noise_key = jax.random.split(key, 3)
    scene = random_scene(scene_key, world, classes)
    robots, pois = jnp.arange(len(world.sensors)), jnp.arange(world.config.arena.num_pois)
    shape = (len(robots), len(pois))

    def stand(key: Key, robot: jax.Array, poi: jax.Array):
        standing = others(scene.poses, robot)
        pose, bearing = _viewpoint(key, world, scene.layout, standing, poi)
        poses = scene.poses.at[robot].set(pose)
        return poses, bearing, arenas.place(world.arena, scene.layout, poses)

    of_pois = jax.vmap(stand, in_axes=(0, None, 0))
    each = jax.vmap(of_pois, in_axes=(0, 0, None))
    poses, bearing, data = each(jax.random.split(viewpoint_key, shape), robots, pois)

    def read(robot: int, key: Key, poses: jax.Array, bearing: jax.Array, data: mjx.Data):
        stood = dataclasses.replace(scene, poses=poses)
        readings = scan_around(key, world, stood, data, robot, bearing)
        return sensors.as_window(world.sensors[robot], readings)

    inputs = jax.random.split(noise_key, shape), poses, bearing, data
    windows = tuple(
        jax.vmap(functools.partial(read, robot))(*jax.tree.map(lambda x: x[robot], inputs))  # noqa: B023
        for robot in range(len(world.sensors))
    )
    return scene, windows


def _viewpoint(key: Key, world: World, layout: arenas.Layout, others: jax.Array, poi: jax.Array):
    config = world.config
    return viewpoints.random_viewpoint(
        key, config.viewpoint, config.arena, layout, others[:, :2], poi
    )
