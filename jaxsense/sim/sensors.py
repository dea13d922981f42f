"""LiDAR scans and camera scanlines: thin layers over the ray-caster.

A sensor is a value: its rays, its height and how it turns hits into readings. `Config.sensors`
names functions that make custom sensors; nothing else in the package names a sensor.
"""

import dataclasses
import hashlib
import importlib
import math
from collections.abc import Callable

import chex
import jax
import jax.numpy as jnp
import numpy as np
from mujoco import mjx

from jaxsense.config import (
    LIDAR_HEIGHT,
    ArenaConfig,
    CameraConfig,
    Config,
    ConfigError,
    LidarConfig,
)
from jaxsense.core import checks
from jaxsense.core.types import Key, pytree
from jaxsense.sim import amiro, disturbances, raycast
from jaxsense.sim.arena import Arena, Layout, check_layout, robot_poses

_LEAST_CHROMA = 0.1  # difference of a pixel's channels, 0 on walls, robots and in the dark
_RANGE_TOLERANCE = 5.0  # standard deviations of the LiDAR's noise
_LEAST_RANGE_TOLERANCE = 0.001  # m, above the rounding of a distance
_SHARE_OF_WIDTH = 0.7  # of a PoI, that a ray must meet
_BACKGROUND = (0.5, 0.6, 0.7)  # colour where a ray leaves the arena


@pytree
class Light:
    """A distant light and ambient light.

    Attributes:
      direction: `[3]` unit vector towards the light.
      diffuse: `[]` strength of the distant light.
      ambient: `[]` strength of the ambient light.
    """

    direction: jax.Array
    diffuse: jax.Array
    ambient: jax.Array


Surfaces = dict[str, jax.Array]
"""Surfaces of G geoms: `colour`, their `[G, 3]` albedo, and `[G]` numbers for each of
`arena.attributes`."""


def _shows_all(readings: jax.Array, distance: jax.Array, extent: float) -> jax.Array:
    """Default of `Sensor.shows`: any ray can have met a PoI."""
    del distance, extent
    return jnp.ones(len(readings), bool)


@dataclasses.dataclass(frozen=True, eq=False)
class Sensor:
    """A scanline sensor on a robot.

    Attributes:
      name: of the modality.
      height: of its rays above the floor, in metres.
      angles: `[B]` of its rays in the robot's frame, in radians, in the order of the readings.
      centre: `bearing [] -> []` real index of the ray along a bearing, in radians.
      window: number of rays that the detector reads.
      read: `(key, hits of B rays, surfaces, light) -> [B, ...] readings`.
      channels: numbers in the reading of one ray.
      stride: step between the rays that the detector reads.
      window_limit: highest reading in the detector's input.
      shows: `(readings [B, ...], distance [], extent) -> [B]` bool, which rays can have met a PoI
        of that extent [m] with its centre at that distance [m]; by default all.
      lost: share of the rays that may read wrongly, on average.
      blind: reading of every ray when the sensor has failed.
      ray_bytes: size of one ray's reading in a ROS message.
    """

    name: str
    height: float
    angles: np.ndarray
    centre: Callable[[jax.Array], jax.Array]
    window: int
    read: Callable[[Key, raycast.Hit, Surfaces, Light], jax.Array]
    channels: int = 1
    stride: int = 1
    window_limit: float = np.inf
    shows: Callable[[jax.Array, jax.Array, float], jax.Array] = _shows_all
    lost: float = 0.0
    blind: float = 0.0
    ray_bytes: int = 4  # float32

    def __post_init__(self):
        for field in ("window", "channels", "stride"):
            checks.require_number(field, getattr(self, field))
        checks.require_positive("height", self.height)

    @property
    def scan_bytes(self) -> int:
        """Size of a whole scan in a ROS message."""
        return self.ray_bytes * len(self.angles)

    @property
    def directions(self) -> np.ndarray:
        """Unit vectors along the rays in the robot's frame, `[2, B]`."""
        angles = self.angles.astype(np.float64)
        return np.stack([np.cos(angles), np.sin(angles)]).astype(np.float32)


def random_light(key: Key) -> Light:
    """Draws a light of random strength from any side, 20 to 70 degrees high."""
    side, height, diffuse, ambient = jax.random.uniform(key, (4,))
    side, height = 2 * jnp.pi * side, jnp.radians(20.0 + 50.0 * height)
    flat = jnp.cos(height)
    direction = jnp.stack([flat * jnp.cos(side), flat * jnp.sin(side), jnp.sin(height)])
    return Light(direction, diffuse=0.2 + 0.6 * diffuse, ambient=0.3 + 0.3 * ambient)


def fan(num_rays: int, field_of_view: float) -> tuple[np.ndarray, Callable]:
    """Spreads rays at equal angles, from right to left.

    Args:
      num_rays: how many.
      field_of_view: angle between the first and the last, in degrees.

    Returns:
      A `Sensor`'s `angles` and `centre`.
    """
    checks.require_number("num_rays", num_rays)
    is_angle = "must be above 0 and at most 360 degrees"
    checks.require("field_of_view", field_of_view, lambda x: (x > 0) & (x <= 360), is_angle)
    half = np.radians(field_of_view) / 2
    angles = np.linspace(-half, half, num_rays, dtype=np.float32)
    step = 2 * half / max(num_rays - 1, 1)
    return angles, lambda bearing: (bearing + half) / step


def lidar(config: LidarConfig) -> Sensor:
    """The laser scanner: one distance in metres per beam, from right to left."""
    angles, centre = fan(config.num_beams, config.field_of_view)

    def read(key, hits, surfaces, light):
        del surfaces, light
        return disturbances.measured_ranges(key, hits.distance, config)

    def shows(readings, distance, extent):
        noise = config.range_noise + config.range_noise_growth * distance
        tolerance = jnp.maximum(_RANGE_TOLERANCE * noise, _LEAST_RANGE_TOLERANCE)
        return jnp.abs(readings - (distance - extent / 2)) <= extent / 2 + tolerance

    return Sensor(
        name="lidar",
        height=LIDAR_HEIGHT,
        angles=angles,
        centre=centre,
        window=config.window,
        read=read,
        stride=config.stride,
        window_limit=config.window_range,
        shows=shows,
        lost=1 - (1 - config.dropout) * (1 - config.mixed_pixels),
        blind=config.max_range,
    )


def camera(config: CameraConfig) -> Sensor:
    """The camera's scanline: linear RGB in [0, 1] per pixel, from left to right."""
    middle = (config.num_pixels - 1) / 2
    focal_length = (config.num_pixels / 2) / np.tan(np.radians(config.field_of_view) / 2)
    columns = np.arange(config.num_pixels)
    angles = np.arctan((middle - columns) / focal_length).astype(np.float32)

    def read(key, hits, surfaces, light):
        normal_x, normal_y = hits.normal
        facing = normal_x * light.direction[0] + normal_y * light.direction[1]
        direct, gains = light.diffuse * jnp.maximum(facing, 0.0), ()
        if disturbances.changes_light(config):
            gain, is_lit = disturbances.lighting(key, len(facing), config)
            direct, gains = direct * is_lit, (gain,)
        shade = light.ambient + direct
        noise = config.pixel_noise * jax.random.normal(key, (3, *hits.geom.shape))

        def channel(of_geom, of_background, noise, *gain):
            lit = shade * raycast.choose(of_geom, hits.geom)
            seen = jnp.where(hits.geom >= 0, lit, of_background)
            return jnp.clip(math.prod(gain, start=seen) + noise, 0.0, 1.0)

        # A loop over the channels makes the compiler finish hits and noise before it shades them;
        # fused with the ray-caster, each channel would cast the rays many times over.
        inputs = surfaces["colour"].T, jnp.array(_BACKGROUND), noise, *gains
        return jax.lax.map(lambda c: channel(*c), inputs).T

    return Sensor(
        name="camera",
        height=amiro.CAMERA_HEIGHT,
        angles=angles,
        centre=lambda bearing: middle - focal_length * jnp.tan(bearing),
        window=config.window,
        read=read,
        channels=3,
        stride=config.stride,
        window_limit=1.0,
        shows=lambda readings, distance, extent: (
            readings.max(axis=-1) - readings.min(axis=-1) >= _LEAST_CHROMA
        ),
        # In little light, it cannot tell a PoI from what covers it.
        lost=0.5 if disturbances.changes_light(config) else 0.0,
        ray_bytes=3,  # rgb8
    )


def make(config: Config) -> tuple[Sensor, ...]:
    """Makes the sensor of each modality, in the order of `config.modalities`."""
    known = {"camera": lambda: camera(config.camera), "lidar": lambda: lidar(config.lidar)}
    return tuple(
        _own(name, config) if name in config.sensors else known[name]()
        for name in config.modalities
    )


def _own(name: str, config: Config) -> Sensor:
    """Makes a custom sensor; raises `ConfigError` if it cannot be made or does not fit."""
    entry, field = config.sensors[name].make, f"sensors.{name}"
    module, _, function = entry.partition(":")
    try:
        make = getattr(importlib.import_module(module), function)
    except (ImportError, AttributeError) as error:
        reason = f"must be a function that can be imported ({error})"
        raise ConfigError(f"{field}.make", entry, reason) from None
    sensor = make(config)
    if not isinstance(sensor, Sensor):
        kind = type(sensor).__name__
        raise ConfigError(f"{field}.make", entry, f"must return a jaxsense.sim.Sensor, not {kind}")
    if not 0 < sensor.height < config.arena.poi_height:
        reason = f"must be above 0 and below arena.poi_height = {config.arena.poi_height} m"
        raise ConfigError(f"{field}: height", sensor.height, reason)
    most = (len(sensor.angles) - 1) // sensor.stride + 1
    if not 1 <= sensor.window <= most:
        reason = f"must be 1 to {most}: it has {len(sensor.angles)} rays and a stride of "
        raise ConfigError(f"{field}: window", sensor.window, f"{reason}{sensor.stride}")
    return dataclasses.replace(sensor, name=name)


def fingerprints(config: Config) -> list[str]:
    """Fingerprints of the custom sensors, which also cover what their functions compute.

    Stored programs close over sensors, whose code is not in the configuration.
    """
    own = [sensor for sensor in make(config) if sensor.name in config.sensors]
    return [_fingerprint(sensor, tuple(config.arena.attributes)) for sensor in own]


def _fingerprint(sensor: Sensor, attributes: tuple[str, ...]) -> str:
    def functions(key: Key, hits: raycast.Hit, surfaces: Surfaces, light: Light, x: jax.Array):
        readings = sensor.read(key, hits, surfaces, light)
        return readings, sensor.shows(readings, x, 0.1), sensor.centre(x)

    rays = jnp.zeros(sensor.window)
    hits = raycast.Hit(rays, rays.astype(jnp.int32), (rays, rays))
    shown = {"colour": jnp.zeros((2, 3)), **{name: jnp.zeros(2) for name in attributes}}
    light, x = Light(jnp.zeros(3), jnp.float32(0), jnp.float32(0)), jnp.float32(0)
    program = jax.jit(functions).lower(jax.random.key(0), hits, shown, light, x).as_text()
    settings = [getattr(sensor, f.name) for f in dataclasses.fields(sensor)]
    text = repr([s for s in settings if not callable(s) and not isinstance(s, np.ndarray)])
    whole = text.encode() + sensor.angles.tobytes() + program.encode()
    return hashlib.sha256(whole).hexdigest()


def surfaces(arena: Arena, layout: Layout) -> Surfaces:
    """Surfaces of all geoms: of PoIs from the layout, of others from model and settings."""
    poi = jnp.array(arena.poi_of_geom)
    albedo = jnp.where((poi >= 0)[:, None], layout.colour[poi], arena.model.geom_rgba[:, :3])
    own = {
        name: jnp.where(poi >= 0, layout.values[name][poi], attribute.elsewhere)
        for name, attribute in arena.config.attributes.items()
    }
    return {"colour": albedo, **own}


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
    """Scans along some rays of one robot's sensor.

    Args:
      key: random key of the noise.
      sensor: the sensor.
      arena: the arena.
      data: its MJX state, after kinematics.
      layout: the PoIs, for their surfaces.
      light: the light.
      robot: index of the robot that carries the sensor, which does not see its own parts.
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
    return sensor.read(key, hits, surfaces(arena, layout), light)


def window_of(sensor: Sensor, values: np.ndarray, bearing: jax.Array) -> jax.Array:
    """Values of those rays of a scan that the detector reads.

    Args:
      sensor: the sensor.
      values: `[..., B]` of all rays, for example `sensor.angles`.
      bearing: `[]` at the centre of these rays, in radians in the robot's frame; near the edge of
        the field of view they stop at its last ray.

    Returns:
      `[..., window]` values.
    """
    chex.assert_rank(bearing, 0, custom_message="bearing")
    *shape, number = values.shape
    start = _first_ray(sensor, bearing)
    # One slice of all rays a stride apart: XLA would recompute a list of indices for each ray, from
    # the bearing on.
    padded = np.pad(values, [(0, 0)] * len(shape) + [(0, -number % sensor.stride)])
    strided = jnp.array(padded.reshape(*shape, -1, sensor.stride))
    place = [0] * len(shape) + [start // sensor.stride, start % sensor.stride]
    return jax.lax.dynamic_slice(strided, place, (*shape, sensor.window, 1))[..., 0]


def _first_ray(sensor: Sensor, bearing: jax.Array) -> jax.Array:
    """Index of the first ray that the detector reads around a bearing, `[]` int32."""
    span = (sensor.window - 1) * sensor.stride
    start = jnp.round(sensor.centre(bearing) - span / 2).astype(jnp.int32)
    return jnp.clip(start, 0, len(sensor.angles) - 1 - span)


def cut_out(sensor: Sensor, readings: jax.Array | np.ndarray, bearing: jax.Array | float):
    """Cuts the detector's input out of a whole scan, recorded or simulated.

    Args:
      sensor: the sensor.
      readings: `[B, ...]` of all its rays in their order: a LiDAR's in metres from right to left, a
        camera's as linear RGB in [0, 1] from left to right.
      bearing: `[]` of the PoI in the robot's frame, in radians, positive to the left.

    Returns:
      `[F]` input of `vae.detect`.
    """
    channels = () if sensor.channels == 1 else (sensor.channels,)
    shape = (len(sensor.angles), *channels)
    chex.assert_shape(readings, shape, custom_message=f"readings of {sensor.name}")
    is_turn = "must be within -pi and pi: it is in radians"
    checks.require("bearing", bearing, lambda x: np.abs(x) <= np.pi, is_turn)
    dtype = jnp.result_type(readings)
    if jnp.issubdtype(dtype, jnp.integer):
        reason = "must be real numbers, in metres or from 0 to 1"
        raise ValueError(f"readings of dtype {dtype}: {reason}")
    at_least = "must be a number that is not negative"
    checks.require(f"readings of {sensor.name}", readings, lambda x: x >= 0, at_least)
    bearing = jnp.asarray(bearing, jnp.float32)
    rays = _first_ray(sensor, bearing) + sensor.stride * jnp.arange(sensor.window)
    return as_window(sensor, jnp.asarray(readings, jnp.float32)[rays])


def shows_poi(
    sensor: Sensor,
    readings: jax.Array,
    bearing: jax.Array,
    distance: jax.Array,
    arena: ArenaConfig,
    bearing_error: jax.Array | float = 0.0,
) -> jax.Array:
    """Whether readings may show a PoI where it is expected.

    The LiDAR judges by distance. The camera distinguishes a PoI from walls, robots and darkness by
    its colour, but not from another PoI before or behind it: good viewpoints have none there.

    Args:
      sensor: the sensor.
      readings: `[window, ...]` of the rays around the bearing.
      bearing: `[]` at which the PoI is expected, in radians in the robot's frame.
      distance: `[]` at which its centre is expected, in metres.
      arena: sizes of PoIs.
      bearing_error: `[]` largest error of the bearing, in radians.

    Returns:
      `[]` bool: a ray that may meet a PoI of this size can have met one, and so can all that must,
      except for twice the share that the sensor loses on average. False for a covered or absent
      PoI, or a failed sensor; of a camera whose light changes, for a failed one only.
    """
    angles = jnp.abs(window_of(sensor, sensor.angles, bearing) - bearing)
    half_width = jnp.arcsin(jnp.minimum(arena.poi_half_width / distance, 1.0))
    shows = sensor.shows(readings, distance, arena.poi_extent)
    must = angles <= jnp.minimum(_SHARE_OF_WIDTH * half_width, half_width - bearing_error)
    may = angles <= half_width + bearing_error
    return jnp.any(may & shows) & (jnp.sum(must & ~shows) <= 2 * sensor.lost * jnp.sum(must))


def as_window(sensor: Sensor, readings: jax.Array) -> jax.Array:
    """Input of the detector, `[F]`, from the `[window, ...]` readings of its rays."""
    chex.assert_axis_dimension(readings, 0, sensor.window, custom_message="readings")
    return jnp.minimum(readings, sensor.window_limit).reshape(-1)
