"""LiDAR scans and camera scanlines: thin layers over the ray-caster.

A sensor is a value: its rays, its height and how it turns hits into readings. Adding one means
adding an entry to `make`; nothing else in the package names a sensor.
"""

import dataclasses
from collections.abc import Callable

import chex
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from mujoco import mjx

from jaxsense.config import ArenaConfig, CameraConfig, Config, LidarConfig
from jaxsense.sim import amiro, raycast
from jaxsense.sim.arena import Arena, Layout, check_layout, robot_poses
from jaxsense.types import Key

_LEAST_CHROMA = 0.1  # difference of a pixel's channels; walls, robots and the dark have none
_RANGE_TOLERANCE = 0.05  # m, five standard deviations of the LiDAR's noise
_SHARE_OF_WIDTH = 0.7  # of a PoI, which is in view however wrong its bearing is believed
_BACKGROUND = (0.5, 0.6, 0.7)  # colour where a ray leaves the arena


@struct.dataclass
class Light:
    """One distant light and the light from all around.

    Attributes:
      direction: `[3]` unit vector towards the light.
      diffuse: `[]` strength of the distant light.
      ambient: `[]` strength of the light from all around.
    """

    direction: jax.Array
    diffuse: jax.Array
    ambient: jax.Array


@dataclasses.dataclass(frozen=True, eq=False)
class Sensor:
    """A scanline sensor on a robot.

    Attributes:
      name: of the modality.
      height: of its rays above the floor, in metres.
      angles: `[B]` of its rays in the robot's frame, in radians, in the order of the readings.
      window: number of rays that the detector reads.
      channels: numbers in the reading of one ray.
      stride: from each ray that the detector reads to the next.
      centre: index, as a real number, of the ray that points along a bearing in radians.
      read: `(key, hits of B rays, [G, 3] albedo of each geom, light) -> [B, ...] readings`.
      window_limit: highest reading that the detector is shown.
      shows: `(readings [B, ...], distance [], extent) -> [B]` bool, which rays can have met a PoI
        of that extent [m] with its centre at that distance [m].
      blind: the reading of every ray when the sensor has failed.
      scan_bytes: size of a whole scan as ROS sends it.
    """

    name: str
    height: float
    angles: np.ndarray
    window: int
    channels: int
    stride: int
    centre: Callable[[jax.Array], jax.Array]
    read: Callable[[Key, raycast.Hit, jax.Array, Light], jax.Array]
    window_limit: float
    shows: Callable[[jax.Array, jax.Array, float], jax.Array]
    blind: float
    scan_bytes: int

    @property
    def directions(self) -> np.ndarray:
        """`[2, B]` unit vectors along the rays in the robot's frame."""
        angles = self.angles.astype(np.float64)
        return np.stack([np.cos(angles), np.sin(angles)]).astype(np.float32)


def random_light(key: Key) -> Light:
    """A light from any side, 20 to 70 degrees high, of random strength."""
    side, height, diffuse, ambient = jax.random.uniform(key, (4,))
    side, height = 2 * jnp.pi * side, jnp.radians(20.0 + 50.0 * height)
    flat = jnp.cos(height)
    direction = jnp.stack([flat * jnp.cos(side), flat * jnp.sin(side), jnp.sin(height)])
    return Light(direction, diffuse=0.2 + 0.6 * diffuse, ambient=0.3 + 0.3 * ambient)


def lidar(config: LidarConfig) -> Sensor:
    """The laser scanner: one distance in metres for each beam, from right to left."""
    half = np.radians(config.field_of_view) / 2
    angles = np.linspace(-half, half, config.num_beams, dtype=np.float32)
    step = 2 * half / max(config.num_beams - 1, 1)

    def read(key, hits, albedo, light):
        del albedo, light
        noise = config.range_noise * jax.random.normal(key, hits.distance.shape)
        measured = jnp.clip(hits.distance + noise, config.min_range, config.max_range)
        return jnp.where(hits.distance <= config.max_range, measured, config.max_range)

    return Sensor(
        name="lidar",
        height=amiro.LIDAR_HEIGHT,
        angles=angles,
        window=config.window,
        channels=1,
        stride=config.stride,
        centre=lambda bearing: (bearing + half) / step,
        read=read,
        window_limit=config.window_range,
        shows=lambda readings, distance, extent: (
            jnp.abs(readings - (distance - extent / 2)) <= extent / 2 + _RANGE_TOLERANCE
        ),
        blind=config.max_range,
        scan_bytes=4 * config.num_beams,  # float32
    )


def camera(config: CameraConfig) -> Sensor:
    """The camera's scanline: linear RGB in [0, 1] for each pixel, from left to right."""
    middle = (config.num_pixels - 1) / 2
    focal_length = (config.num_pixels / 2) / np.tan(np.radians(config.field_of_view) / 2)
    columns = np.arange(config.num_pixels)
    angles = np.arctan((middle - columns) / focal_length).astype(np.float32)

    def read(key, hits, albedo, light):
        normal_x, normal_y = hits.normal
        facing = normal_x * light.direction[0] + normal_y * light.direction[1]
        shade = light.ambient + light.diffuse * jnp.maximum(facing, 0.0)

        noise = config.pixel_noise * jax.random.normal(key, (3, *hits.geom.shape))

        def channel(of_geom, of_background, noise):
            lit = shade * raycast.choose(of_geom, hits.geom)
            seen = jnp.where(hits.geom >= 0, lit, of_background)
            return jnp.clip(seen + noise, 0.0, 1.0)

        # A loop over the channels makes the compiler finish hits and noise before it shades them;
        # fused with the ray-caster, each channel would cast the rays many times over.
        inputs = albedo.T, jnp.array(_BACKGROUND), noise
        return jax.lax.map(lambda c: channel(*c), inputs).T

    return Sensor(
        name="camera",
        height=amiro.CAMERA_HEIGHT,
        angles=angles,
        window=config.window,
        channels=3,
        stride=config.stride,
        centre=lambda bearing: middle - focal_length * jnp.tan(bearing),
        read=read,
        window_limit=1.0,
        shows=lambda readings, distance, extent: (
            readings.max(axis=-1) - readings.min(axis=-1) >= _LEAST_CHROMA
        ),
        blind=0.0,
        scan_bytes=3 * config.num_pixels,  # rgb8
    )


def make(config: Config) -> tuple[Sensor, ...]:
    """The sensor of each modality, in the order of `config.modalities`."""
    known = {"camera": lambda: camera(config.camera), "lidar": lambda: lidar(config.lidar)}
    return tuple(known[modality]() for modality in config.modalities)


def palette(arena: Arena, layout: Layout) -> jax.Array:
    """`[G, 3]` albedo of every geom: the PoIs' from the layout, the others' from the model."""
    poi = jnp.array(arena.poi_of_geom)
    return jnp.where((poi >= 0)[:, None], layout.colour[poi], arena.model.geom_rgba[:, :3])


def scan(
    key: Key,
    sensor: Sensor,
    arena: Arena,
    data: mjx.Data,
    layout: Layout,
    light: Light,
    robot: int,
    directions: jax.Array,
) -> jax.Array:
    """Readings of one robot's sensor along some of its rays.

    Args:
      key: random key of the noise.
      sensor: the sensor.
      arena: the arena.
      data: its MJX state, after kinematics.
      layout: the PoIs, for their colours.
      light: the light.
      robot: index of the robot that carries the sensor; its own parts are not seen.
      directions: `[2, B]` unit vectors in the robot's frame; `sensor.directions` for a full scan.

    Returns:
      `[B, ...]` readings.
    """
    chex.assert_shape(directions, (2, None), custom_message="directions")
    chex.assert_shape(light.direction, (3,), custom_message="light.direction")
    check_layout(arena.config, layout)
    pose = robot_poses(data)[robot]
    section = raycast.cross_section(arena, data, sensor.height, robot)
    in_world = raycast.turned((directions[0], directions[1]), pose[2])
    hits = raycast.cast_along(section, pose[:2], in_world)
    return sensor.read(key, hits, palette(arena, layout), light)


def window_of(sensor: Sensor, values: np.ndarray, bearing: jax.Array) -> jax.Array:
    """Those values that belong to the rays which the detector reads of a scan.

    Args:
      sensor: the sensor.
      values: `[..., B]` of all rays, for example `sensor.angles`.
      bearing: `[]` around which the rays lie, in radians in the robot's frame; near the edge of the
        field of view they stop at its last ray.

    Returns:
      `[..., window]` values.
    """
    chex.assert_rank(bearing, 0, custom_message="bearing")
    *shape, number = values.shape
    span = (sensor.window - 1) * sensor.stride
    start = jnp.round(sensor.centre(bearing) - span / 2).astype(jnp.int32)
    start = jnp.clip(start, 0, number - 1 - span)
    # Cut out as one piece, of every ray that is a stride from the next: a list of indices would
    # be worked out for each ray from the bearing on.
    padded = np.pad(values, [(0, 0)] * len(shape) + [(0, -number % sensor.stride)])
    strided = jnp.array(padded.reshape(*shape, -1, sensor.stride))
    place = [0] * len(shape) + [start // sensor.stride, start % sensor.stride]
    return jax.lax.dynamic_slice(strided, place, (*shape, sensor.window, 1))[..., 0]


def shows_poi(
    sensor: Sensor,
    readings: jax.Array,
    bearing: jax.Array,
    distance: jax.Array,
    arena: ArenaConfig,
) -> jax.Array:
    """Whether a PoI may be seen where it is expected, from the readings alone.

    The LiDAR tells by the distance. A camera tells a PoI from walls, robots and darkness by its
    colour, but not from another PoI before or behind it: viewpoints are chosen to have none there.

    Args:
      sensor: the sensor.
      readings: `[window, ...]` of the rays around the bearing.
      bearing: `[]` at which the PoI is expected, in radians in the robot's frame.
      distance: `[]` at which its centre is expected, in metres.
      arena: sizes of PoIs.

    Returns:
      `[]` bool: all rays that must meet a PoI of that size can have met one. Something else before
      it, a PoI that is not there and a sensor that has failed give False.
    """
    angles = window_of(sensor, sensor.angles, bearing) - bearing
    half_width = jnp.arcsin(jnp.minimum(arena.poi_radius / distance, 1.0))
    is_within = jnp.abs(angles) <= _SHARE_OF_WIDTH * half_width
    return jnp.all(sensor.shows(readings, distance, arena.poi_extent) | ~is_within)


def as_window(sensor: Sensor, readings: jax.Array) -> jax.Array:
    """`[F]` the detector's input from the `[window, ...]` readings of the rays it reads."""
    chex.assert_axis_dimension(readings, 0, sensor.window, custom_message="readings")
    return jnp.minimum(readings, sensor.window_limit).reshape(-1)
