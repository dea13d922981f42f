"""Scenes in simulated arenas, and looks at their PoIs.

`look` and `survey` stand a robot somewhere and scan. Surveys, banks and live episodes take them;
the robots of missions stand where they have driven to, and call `scan_around` from there.
"""

import dataclasses

import chex
import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int
from mujoco import mjx

from jaxsense.config import Config
from jaxsense.config.mission import LocalisationConfig
from jaxsense.config.scene import CLEARANCE, MAX_BEARING, ViewpointConfig
from jaxsense.config.section import require_32_bits
from jaxsense.core import checks
from jaxsense.core.types import Index, Key, others, pytree
from jaxsense.sim import arena as arenas
from jaxsense.sim import localisation, sensors, viewpoints, windows
from jaxsense.sim.light import Light, random_light
from jaxsense.sim.viewpoints import View

_NUM_CANDIDATES = 16


@pytree
class World:
    """A simulation: its arena, sensors and viewpoints, which all scenes share.

    Attributes:
      arena: the compiled arena; static.
      sensors: the sensor of each modality; in training robot m carries the m-th.
      viewpoint: the settings of viewpoints.
      localisation: errors of the poses that robots believe they have; None if they know them.
    """

    arena: arenas.Arena = struct.field(pytree_node=False)
    sensors: tuple[sensors.Sensor, ...]
    viewpoint: ViewpointConfig
    localisation: LocalisationConfig | None

    @property
    def reads_conditions(self) -> bool:
        """Whether a sensor reads the conditions of the light, see `Sensor.reads_conditions`."""
        return any(sensor.reads_conditions for sensor in self.sensors)


@pytree
class Scene:
    """State of one arena: PoIs, light and robot poses, which determine the MJX state.

    Attributes:
      poses: `[R, 3]` x [m], y [m] and yaw [rad] of each robot.
    """

    layout: arenas.Layout
    light: Light
    poses: jax.Array


@checks.typed
def make_world(
    config: Config,
    robots: tuple[str, ...] | None = None,
    *,
    contacts: bool = False,
) -> World:
    """Makes the simulation that `config` describes.

    Args:
      config: all settings; numbers that are declared `Traced` may be traced.
      robots: modality of each robot; by default one robot per modality, in the order of
        `config.modalities`, as training needs.
      contacts: whether robots collide, see `arena.build`.

    Raises:
      ConfigError: if a custom sensor is wrong, see `sensors.make`, or JAX computes in 64 bits.
    """
    require_32_bits()
    on_top = sensors.on_top(config, robots or config.modalities)
    arena = arenas.build(config.arena, on_top, contacts=contacts)
    errors = config.mission.localisation
    localised = errors if errors.in_training else None
    return World(arena, sensors.make(config), config.viewpoint, localised)


def random_viewpoint(
    key: Key,
    world: World,
    layout: arenas.Layout,
    others: Float[Array, "K 2"],
    poi: Int[Array, ""],
) -> tuple[Float[Array, "3"], Float[Array, ""]]:
    """Pose from which a robot looks at a PoI, and the bearing of the PoI as it believes it.

    Candidates are uniform in distance and direction. Returns the first one that is free and has an
    unobstructed view of the PoI, or the one with the most room if there is none.

    Args:
      others: positions of the other robots, in metres.
    """
    chex.assert_shape(others, (None, 2))
    # A single draw, because each use of the random generator takes long to compile.
    draws = jax.random.uniform(key, (2 * _NUM_CANDIDATES + 2,))
    near, far = world.viewpoint.min_distance, world.viewpoint.max_distance
    distance = near + (far - near) * draws[:_NUM_CANDIDATES]
    side = jnp.pi * (2 * draws[_NUM_CANDIDATES:-2] - 1)
    target = layout.position[poi]
    x, y = target[0] + distance * jnp.cos(side), target[1] + distance * jnp.sin(side)
    room = viewpoints.free_room(x, y, CLEARANCE, world.arena.config, layout, others, poi)
    chosen = jnp.where(jnp.any(room > 0), jnp.argmax(room > 0), jnp.argmax(room))
    bearing, believed = _bearings(draws[-2], draws[-1], world.viewpoint)
    return jnp.stack([x[chosen], y[chosen], side[chosen] + jnp.pi - bearing]), believed


def moved_viewpoint(
    key: Key,
    world: World,
    layout: arenas.Layout,
    others: Float[Array, "K 2"],
    poi: Int[Array, ""],
    position: Float[Array, "2"],
    distance: Float[Array, ""],
) -> tuple[Float[Array, "3"], Float[Array, ""]]:
    """`random_viewpoint` at a distance from a place, in metres.

    The pose is at the place itself if no free one at that distance is in range and shows the PoI.
    """
    draws = jax.random.uniform(key, (_NUM_CANDIDATES + 2,))
    direction, target = jnp.pi * (2 * draws[:-2] - 1), layout.position[poi]
    x = position[0] + distance * jnp.cos(direction)
    y = position[1] + distance * jnp.sin(direction)
    to_poi = jnp.sqrt((x - target[0]) ** 2 + (y - target[1]) ** 2)
    near, far = world.viewpoint.min_distance, world.viewpoint.max_distance
    room = viewpoints.free_room(x, y, CLEARANCE, world.arena.config, layout, others, poi)
    is_free = (room > 0) & (to_poi >= near) & (to_poi <= far)
    chosen = jnp.argmax(is_free)
    stand = jnp.where(jnp.any(is_free), jnp.stack([x[chosen], y[chosen]]), position)
    bearing, believed = _bearings(draws[-2], draws[-1], world.viewpoint)
    yaw = jnp.arctan2(target[1] - stand[1], target[0] - stand[0]) - bearing
    return jnp.append(stand, yaw), believed


def _bearings(
    heading: jax.Array, error: jax.Array, config: ViewpointConfig
) -> tuple[jax.Array, jax.Array]:
    """Bearing of a PoI, and the one that the robot believes, from uniform draws."""
    bearing = jnp.radians(MAX_BEARING) * (2 * heading - 1)
    return bearing, bearing + jnp.radians(config.bearing_error) * (2 * error - 1)


def random_scene(
    key: Key, world: World, classes: Int[Array, "N"], places: Key | None = None
) -> Scene:
    """Draws a scene under random light, each robot at a random viewpoint of a random PoI.

    Args:
      places: random key of the PoIs' positions and directions, with which several scenes show the
        same PoIs; part of `key` by default.
    """
    checks.require_key(key)
    layout_key, light_key, poi_key, *robot_keys = jax.random.split(key, 3 + len(world.sensors))
    place_key = layout_key if places is None else places
    layout = arenas.random_layout(place_key, world.arena.config, classes)
    pois = jax.random.randint(poi_key, (len(robot_keys),), 0, world.arena.config.num_pois)
    poses = jnp.zeros((0, 3))
    for robot_key, poi in zip(robot_keys, pois, strict=True):
        pose, _ = random_viewpoint(robot_key, world, layout, poses[:, :2], poi)
        poses = jnp.concatenate([poses, pose[None]])
    return Scene(layout, random_light(light_key, world.reads_conditions), poses)


def look(
    key: Key,
    world: World,
    scene: Scene,
    robot: int,
    poi: Int[Array, ""],
    farthest: Float[Array, ""] | float | None = None,
) -> tuple[tuple[Float[Array, "F"], Float[Array, ""]], Scene]:
    """Places a robot at a random viewpoint of a PoI, and scans the PoI.

    Casts only the rays that it needs; readings have the distribution of those of a whole scan.

    Args:
      robot: index of the robot and of its modality; static.
      farthest: distance up to which the viewpoint is from where the robot stands, in metres; most
        of the time much less. By default anywhere.

    Returns:
      The detector's input and the expected distance of the PoI in metres, and the scene with the
      robot at its viewpoint.
    """
    checks.require_key(key)
    checks.require_index("robot", robot, len(world.sensors))
    checks.require_index("poi", poi, world.arena.config.num_pois)
    moved = None
    if farthest is None:
        viewpoint_key, noise_key, error_key = jax.random.split(key, 3)
    else:
        distance_key, viewpoint_key, noise_key, error_key = jax.random.split(key, 4)
        moved = farthest * jax.random.uniform(distance_key) ** 3
    scene, believed = _stand(viewpoint_key, error_key, world, scene, robot, poi, moved)
    bearing, distance = believed
    return (window_around(noise_key, world, scene, robot, bearing), distance), scene


def _stand(
    viewpoint_key: Key,
    error_key: Key,
    world: World,
    scene: Scene,
    robot: Index,
    poi: Int[Array, ""],
    moved: Float[Array, ""] | None = None,
) -> tuple[Scene, tuple[Float[Array, ""], Float[Array, ""]]]:
    """The scene with a robot at a viewpoint of a PoI, and what it believes, see `_believed`.

    Args:
      moved: distance from where the robot stands, in metres; by default anywhere.
    """
    given = world, scene.layout, others(scene.poses[:, :2], robot), poi
    if moved is None:
        pose, bearing = random_viewpoint(viewpoint_key, *given)
    else:
        pose, bearing = moved_viewpoint(viewpoint_key, *given, scene.poses[robot, :2], moved)
    believed = _believed(error_key, world, pose, bearing, scene.layout.position[poi])
    return dataclasses.replace(scene, poses=scene.poses.at[robot].set(pose)), believed


def window_around(
    key: Key,
    world: World,
    scene: Scene,
    robot: int,
    bearing: Float[Array, ""],
    twin: Float[Array, "2"] | None = None,
) -> Float[Array, "F"]:
    """Input of the detector of a robot's own sensor, see `scan_around`."""
    data = arenas.place(world.arena, scene.layout, scene.poses)
    readings = scan_around(key, world, scene, data, robot, bearing, robot, twin=twin)
    return windows.as_window(world.sensors[robot], readings)


def scan_around(
    key: Key,
    world: World,
    scene: Scene,
    data: mjx.Data,
    robot: Index,
    bearing: Float[Array, ""],
    modality: int,
    seconds: Float[Array, ""] | float = 0.0,
    twin: Float[Array, "2"] | None = None,
) -> Float[Array, "window *channels"]:
    """Readings of the rays that the detector reads around a bearing, from a robot's current pose.

    Args:
      data: the scene's MJX state, from `place`.
      robot: index of the robot, which may be traced.
      bearing: of the window's centre in the robot's frame, in radians.
      modality: index of the robot's sensor; static, because sensors differ in shape.
      seconds: time of the scan, over which the light changes.
      twin: position of one more robot, see `sensors.scan`.
    """
    sensor = world.sensors[modality]
    rays, (layout, light) = windows.rays_of(sensor, bearing), (scene.layout, scene.light)
    readings = sensors.scan(
        key, sensor, world.arena, data, layout, light, robot, rays, seconds=seconds, twin=twin
    )
    return readings[: -1 : sensor.stride] if sensor.reads_neighbours else readings


def survey(
    key: Key,
    world: World,
    classes: Int[Array, "N"],
    is_empty: Bool[Array, ""],
    places: Key | None = None,
) -> tuple[tuple[Float[Array, "N _"], ...], Float[Array, "R N"]]:
    """Draws a scene in which each robot looks at each PoI, every time from a new viewpoint.

    Args:
      is_empty: whether no look shows its PoI, see `viewpoints.without_poi`.
      places: see `random_scene`.

    Returns:
      For each robot the inputs of its detector, one per PoI, and the expected distances of the
      PoIs, in metres.
    """
    checks.require_key(key)
    scene_key, viewpoint_key, noise_key = jax.random.split(key, 3)
    scene = random_scene(scene_key, world, classes, places)
    robots, pois = jnp.arange(len(world.sensors)), jnp.arange(world.arena.config.num_pois)
    shape = (len(robots), len(pois))

    away = jnp.array(viewpoints.outside(world.arena.config))

    def view_of(key: Key, robot: jax.Array, poi: jax.Array) -> View:
        pose_key, error_key, absent_key = jax.random.split(key, 3)
        stood, believed = _stand(pose_key, error_key, world, scene, robot, poi)
        view = View(scene.layout.position, stood.poses, away, *believed)
        absent = viewpoints.without_poi(
            absent_key, world.sensors, world.arena.config, world.viewpoint, view, robot, poi
        )
        return jax.tree.map(lambda *x: jnp.where(is_empty, *x), absent, view)

    of_pois = jax.vmap(view_of, in_axes=(0, None, 0))
    each = jax.vmap(of_pois, in_axes=(0, 0, None))
    views = each(jax.random.split(viewpoint_key, shape), robots, pois)
    noise_keys = jax.random.split(noise_key, shape)

    def read_all(robot: int) -> jax.Array:
        def read(key: Key, view: View) -> jax.Array:
            layout = dataclasses.replace(scene.layout, position=view.positions)
            stood = Scene(layout, scene.light, view.poses)
            return window_around(key, world, stood, robot, view.bearing, view.twin)

        return jax.vmap(read)(noise_keys[robot], jax.tree.map(lambda x: x[robot], views))

    return tuple(map(read_all, range(len(world.sensors)))), views.distance


def _believed(
    key: Key,
    world: World,
    pose: Float[Array, "3"],
    bearing: Float[Array, ""],
    position: Float[Array, "2"],
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Bearing [rad] and distance [m] of a PoI as a robot believes, with errors of localisation."""
    if world.localisation is None:
        return bearing, jnp.linalg.norm(position - pose[:2])
    believed = pose + localisation.draw(key, world.localisation, 1)[0]
    turned = viewpoints.bearing(believed, position) - viewpoints.bearing(pose, position)
    return bearing + turned, jnp.linalg.norm(position - believed[:2])
