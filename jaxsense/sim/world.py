"""Looking at points of interest in simulated arenas: all that training needs of the simulator."""

import dataclasses

import chex
import jax
import jax.numpy as jnp
from flax import struct

from jaxsense.config import Config
from jaxsense.sim import arena as arenas
from jaxsense.sim import sensors, viewpoints
from jaxsense.types import Key


@dataclasses.dataclass(frozen=True, eq=False)
class World:
    """The parts of a simulation that are the same for all scenes. Static under `jit`.

    Attributes:
      config: all settings.
      arena: the compiled arena, with one robot for each modality.
      sensors: the sensor of each robot.
    """

    config: Config
    arena: arenas.Arena
    sensors: tuple[sensors.Sensor, ...]


@struct.dataclass
class Scene:
    """One arena at one moment: what its MJX state is made from.

    Attributes:
      layout: the PoIs.
      light: the light.
      poses: `[R, 3]` x [m], y [m] and yaw [rad] of each robot.
    """

    layout: arenas.Layout
    light: sensors.Light
    poses: jax.Array


def make_world(config: Config, *, contacts: bool = False) -> World:
    """Compiles the arena that `config` describes, with one robot for each modality."""
    carries_lidar = tuple(modality == "lidar" for modality in config.modalities)
    arena = arenas.build(config.arena, carries_lidar, contacts=contacts)
    return World(config, arena, sensors.make(config))


def random_scene(key: Key, world: World, classes: jax.Array) -> Scene:
    """A scene with PoIs of the given classes at random places under random light.

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

    Only the rays that the detector reads are cast; they read what they would in a full scan.

    Args:
      key: random key.
      world: the simulation.
      scene: the present scene.
      robot: index of the robot, which is that of its modality; static.
      poi: `[]` int32 index of the PoI.

    Returns:
      `[F]` the detector's input, and the scene with the robot at its viewpoint.
    """
    if not 0 <= robot < len(world.sensors):
        raise ValueError(f"robot = {robot}: must be one of the {len(world.sensors)} robots")
    chex.assert_rank(poi, 0, custom_message="poi")
    viewpoint_key, noise_key = jax.random.split(key)
    others = jnp.delete(scene.poses, robot, axis=0)
    pose, bearing = _viewpoint(viewpoint_key, world, scene.layout, others, poi)
    scene = dataclasses.replace(scene, poses=scene.poses.at[robot].set(pose))
    readings = scan_around(noise_key, world, scene, robot, bearing)
    return sensors.as_window(world.sensors[robot], readings), scene


def scan_around(key: Key, world: World, scene: Scene, robot: int, bearing: jax.Array) -> jax.Array:
    """What a robot's sensor reads around a bearing from where the robot stands.

    Args:
      key: random key of the noise.
      world: the simulation.
      scene: where everything stands.
      robot: index of the robot; static.
      bearing: `[]` in the robot's frame, in radians.

    Returns:
      `[window, ...]` readings of the rays that the detector reads.
    """
    data = arenas.place(world.arena, scene.layout, scene.poses)
    sensor = world.sensors[robot]
    angles = jnp.array(sensor.angles)[sensors.window_rays(sensor, bearing)]
    return sensors.scan(key, sensor, world.arena, data, scene.layout, scene.light, robot, angles)


def first_look(key: Key, world: World, robot: int, poi_class: jax.Array) -> jax.Array:
    """`[F]` what a robot's detector reads of a PoI of a class in a new random scene."""
    chex.assert_rank(poi_class, 0, custom_message="poi_class")
    class_key, scene_key, look_key = jax.random.split(key, 3)
    arena = world.config.arena
    others = jax.random.randint(class_key, (arena.num_pois - 1,), 0, len(arena.classes))
    scene = random_scene(scene_key, world, jnp.append(others, poi_class))
    window, _ = look(look_key, world, scene, robot, jnp.int32(arena.num_pois - 1))
    return window


def _viewpoint(key: Key, world: World, layout: arenas.Layout, others: jax.Array, poi: jax.Array):
    config = world.config
    return viewpoints.random_viewpoint(
        key, config.viewpoint, config.arena, layout, others[:, :2], poi
    )
