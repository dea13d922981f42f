"""Sensors: rays at one height above the floor, and readings computed from their hits.

A sensor is a value with methods. `Lidar` and `Camera` are built in. Your own sensor is another
subclass of `Sensor`, made by a function that `Config.sensors` names; the rest of the package treats
all sensors alike.
"""

import abc
import dataclasses
from typing import dataclass_transform

import chex
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float
from mujoco import mjx

from jaxsense.config import CameraConfig, Config, ConfigError, LidarConfig
from jaxsense.config.scene import LIDAR_HEIGHT, POI_HEIGHT
from jaxsense.config.section import named_function
from jaxsense.core import checks
from jaxsense.core.types import Index, Key, is_static, pytree
from jaxsense.sim import amiro, raycast
from jaxsense.sim.arena import Arena, Layout, robot_poses, sized
from jaxsense.sim.light import Light, lighting
from jaxsense.sim.raycast import Fan, Pinhole, Rays

_BACKGROUND = (0.5, 0.6, 0.7)  # colour outside the arena
_ROUNDING = 1e-4  # of a brightness

Surfaces = dict[str, jax.Array]
"""Surfaces of G geoms: `colour`, the `[G, 3]` albedo, and the `[G]` values of each of
`arena.attributes`."""


@dataclass_transform(frozen_default=True, field_specifiers=(struct.field,))
@pytree
class Sensor(abc.ABC):
    """A scanline sensor on a robot, a frozen pytree.

    A subclass defines `read`. It becomes a dataclass and a pytree without a decorator; its own
    fields are leaves unless declared `flax.struct.field(pytree_node=False)`.

    Attributes:
      name: of the modality, which `make` takes from the settings.
      height: of the rays above the floor, in metres.
      rays: their directions.
      window: number of rays that the detector reads.
      channels: numbers in the reading of one ray.
      stride: step between the rays that the detector reads.
      window_limit: highest reading in the detector's input.
      measures_distance: whether readings are distances in metres.
      blind: reading of every ray after the sensor has failed.
    """

    _: dataclasses.KW_ONLY
    name: str = struct.field(pytree_node=False, default="")
    height: float = struct.field(pytree_node=False)
    rays: Rays = struct.field(pytree_node=False)
    window: int = struct.field(pytree_node=False)
    channels: int = struct.field(pytree_node=False, default=1)
    stride: int = struct.field(pytree_node=False, default=1)
    measures_distance: bool = struct.field(pytree_node=False, default=False)
    window_limit: float | jax.Array = np.inf
    blind: float | jax.Array = 0.0

    def __init_subclass__(cls):
        pytree(cls)

    def __post_init__(self):
        for field in ("window", "channels", "stride"):
            checks.require_number(field, getattr(self, field))
        checks.require_positive("height", self.height)

    @abc.abstractmethod
    def read(
        self, key: Key, hits: raycast.Hit, surfaces: Surfaces, light: Light
    ) -> Float[Array, "B *channels"]:
        """Readings of one scan, `[B, channels]` if there are several channels.

        Args:
          hits: `[B]` first hits of the rays: of a whole scan, or of some of its rays, which
            `hits.ray` tells.
          surfaces: colour and attributes of all geoms, for `raycast.choose`.
          light: the light, with the point where and when the sensor looks.
        """

    def from_left(
        self, windows: Float[np.ndarray, "*S F"]
    ) -> Float[np.ndarray, "*S window channels"]:
        """Readings of the rays of a detector's inputs, from left to right."""
        rays = windows.reshape(*windows.shape[:-1], self.window, self.channels)
        return rays if self.angles[0] > self.angles[-1] else rays[..., ::-1, :]

    def is_valid(
        self, readings: Float[Array | np.ndarray, "*axes"]
    ) -> Bool[Array | np.ndarray, "*axes"]:
        """Which readings the sensor can make; a beam without a return is infinitely long."""
        return readings >= 0 if self.measures_distance else jnp.isfinite(readings)

    @property
    def reads_conditions(self) -> bool:
        """Whether `read` needs `light.conditions`; by default not, and they may not be drawn."""
        return False

    @property
    def reads_neighbours(self) -> bool:
        """Whether a ray's reading depends on the next ray's hit, too; by default not."""
        return False

    @property
    def angles(self) -> Float[np.ndarray, "B"]:
        """Angles of the rays in the robot's frame, in radians, in the order of the readings."""
        return self.rays.angles

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the readings of a whole scan."""
        return (len(self.angles), *[self.channels] * (self.channels > 1))

    @property
    def is_on_top(self) -> bool:
        """Whether it is mounted on top of the robot's body, as the LiDAR is."""
        return self.height > amiro.BODY_TOP

    @property
    def field_of_view(self) -> float:
        """Angle between the outermost rays, in degrees."""
        return float(np.degrees(np.ptp(self.angles)))

    @property
    def steps(self) -> tuple[float, float]:
        """Smallest and largest angle between rays that a detector reads, in radians; 0 of one."""
        found = np.abs(np.diff(self.angles[:: self.stride]))
        return (float(found.min()), float(found.max())) if found.size else (0.0, 0.0)

    @property
    def directions(self) -> Float[np.ndarray, "2 B"]:
        """Unit vectors along the rays in the robot's frame."""
        angles = self.angles.astype(np.float64)
        return np.stack([np.cos(angles), np.sin(angles)]).astype(np.float32)


class Lidar(Sensor):
    """A laser scanner: one distance in metres per beam, from right to left."""

    config: LidarConfig

    def read(
        self, key: Key, hits: raycast.Hit, surfaces: Surfaces, light: Light
    ) -> Float[Array, "B *channels"]:
        """Measured ranges; `max_range` without a return."""
        del surfaces, light
        config, met = self.config, hits.distance
        spread = config.range_noise
        if config.mixed_pixels > 0 or config.dropout > 0:
            key, disturbance_key = jax.random.split(key)
            met = _disturbed(disturbance_key, met, config)
        if config.range_noise_growth > 0:
            spread += config.range_noise_growth * jnp.minimum(met, config.max_range)
        noise = spread * jax.random.normal(key, met.shape)
        measured = jnp.clip(met + noise, config.min_range, config.max_range)
        return jnp.where(met <= config.max_range, measured, config.max_range)

    @property
    def reads_neighbours(self) -> bool:
        """See `Sensor.reads_neighbours`: whether there are mixed pixels."""
        return self.config.mixed_pixels > 0


def _disturbed(key: Key, distance: Float[Array, "B"], config: LidarConfig) -> Float[Array, "B"]:
    """Distances with mixed pixels, infinite where a beam drops out."""
    uniform = jax.random.uniform(key, (3, *distance.shape))
    # The last beam has no neighbour.
    following = jnp.append(distance[1:], distance[-1:])
    # Nothing lies between a surface and nothing. The scanner detects nothing beyond its range.
    is_edge = jnp.maximum(distance, following) <= config.max_range
    between = distance + uniform[0] * jnp.where(is_edge, following - distance, 0.0)
    met = jnp.where(uniform[1] < config.mixed_pixels, between, distance)
    return jnp.where(uniform[2] < config.dropout, jnp.inf, met)


class Camera(Sensor):
    """One line of a camera's pixels: linear RGB in [0, 1], from left to right."""

    config: CameraConfig

    def is_valid(
        self, readings: Float[Array | np.ndarray, "*axes"]
    ) -> Bool[Array | np.ndarray, "*axes"]:
        """See `Sensor.is_valid`."""
        return (readings >= 0) & (readings <= 1 + _ROUNDING)

    def read(
        self, key: Key, hits: raycast.Hit, surfaces: Surfaces, light: Light
    ) -> Float[Array, "B *channels"]:
        """See `Sensor.read`."""
        normal_x, normal_y = hits.normal
        facing = normal_x * light.direction[0] + normal_y * light.direction[1]
        direct, gain = light.diffuse * jnp.maximum(facing, 0.0), None
        if self.reads_conditions:
            values = light.changes()
            place = jnp.asarray(hits.ray) / self.config.num_pixels
            gain, is_lit = lighting(values, place, self.config)
            direct = direct * is_lit
        shade = light.ambient + direct
        noise = self.config.pixel_noise * jax.random.normal(key, (3, *hits.geom.shape))

        def channel(given):
            of_geom, of_background, noise, gain = given
            lit = shade * raycast.choose(of_geom, hits.geom)
            seen = jnp.where(hits.geom >= 0, lit, of_background)
            return jnp.clip((seen if gain is None else seen * gain) + noise, 0.0, 1.0)

        # The loop over channels makes the compiler finish hits and noise first; fused with the
        # ray-caster, each channel would cast the rays many times over.
        inputs = surfaces["colour"].T, jnp.array(_BACKGROUND), noise, gain
        return jax.lax.map(channel, inputs).T

    @property
    def reads_conditions(self) -> bool:
        """See `Sensor.reads_conditions`: whether the settings change the light."""
        of = self.config
        amounts = of.exposure_error, of.colour_cast, of.low_light, of.shadow
        return any(amount > 0 for amount in amounts)


def lidar(config: LidarConfig) -> Lidar:
    """The built-in LiDAR; its settings may be traced."""
    return Lidar(
        config,
        name="lidar",
        height=LIDAR_HEIGHT,
        rays=Fan(config.num_beams, config.field_of_view),
        window=config.window,
        measures_distance=True,
        window_limit=config.window_range,
        blind=config.max_range,
    )


def camera(config: CameraConfig) -> Camera:
    """The built-in camera; its settings may be traced."""
    return Camera(
        config,
        name="camera",
        height=amiro.CAMERA_HEIGHT,
        rays=Pinhole(config.num_pixels, config.field_of_view),
        window=config.window,
        channels=3,
        stride=config.stride,
        window_limit=1.0,
    )


def make(config: Config) -> tuple[Sensor, ...]:
    """Sensor of each modality, in the order of `config.modalities`.

    Numbers of `config` that are declared `Traced` may be traced.

    Raises:
      ConfigError: if a custom sensor cannot be imported, is no `Sensor`, or does not fit the arena.
    """
    known = {"camera": lambda: camera(config.camera), "lidar": lambda: lidar(config.lidar)}
    return tuple(
        _own(name, config) if name in config.sensors else known[name]()
        for name in config.modalities
    )


def on_top(config: Config, carried: tuple[str, ...]) -> tuple[bool, ...]:
    """Which robots, by the modality that they carry, have a sensor on top of their bodies."""
    is_on_top = {sensor.name: sensor.is_on_top for sensor in make(config)}
    return tuple(is_on_top[name] for name in carried)


def _own(name: str, config: Config) -> Sensor:
    """Makes a custom sensor and checks it."""
    path, field = config.sensors[name].make, f"sensors.{name}"
    sensor = named_function(f"{field}.make", path)(config)
    if not isinstance(sensor, Sensor):
        kind = type(sensor).__name__
        raise ConfigError(f"{field}.make", path, f"must return a jaxsense.sim.Sensor, not {kind}")
    if not 0 < sensor.height < POI_HEIGHT:
        reason = f"must be above 0 and below {POI_HEIGHT} m, the height of PoIs"
        raise ConfigError(f"{field}: height", sensor.height, reason)
    most = (len(sensor.angles) - 1) // sensor.stride + 1
    if not 1 <= sensor.window <= most:
        reason = f"must be 1 to {most}: it has {len(sensor.angles)} rays and a stride of "
        raise ConfigError(f"{field}: window", sensor.window, f"{reason}{sensor.stride}")
    return dataclasses.replace(sensor, name=name)


def surfaces(arena: Arena, layout: Layout) -> Surfaces:
    """Colour and attributes of all geoms."""
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
    robot: Index,
    directions: Float[Array | np.ndarray, "2 B"],
    seconds: Float[Array, ""] | float = 0.0,
    twin: Float[Array, "2"] | None = None,
) -> Float[Array, "B *channels"]:
    """Readings of a robot's sensor, along all of its rays or some of them.

    Args:
      data: the arena's MJX state, after kinematics.
      robot: index of the robot that carries the sensor and does not see its own body. May be
        traced; a static index saves casting rays at that body.
      directions: unit vectors in the robot's frame; `sensor.directions` for a whole scan. A mixed
        pixel lies between the surfaces of two of these rays, one after the other.
      seconds: time of the scan, over which the light changes.
      twin: position of one more robot with the body of the one that scans, in metres.

    Raises:
      ValueError: if the sensor reads the light's conditions, and they have not been drawn.
    """
    checks.require_key(key)
    chex.assert_shape(directions, (2, None))
    arena, pose = sized(arena, layout), robot_poses(data)[robot]
    section = _section(arena, data, sensor.height, robot, twin)
    x, y = directions
    in_world = raycast.turned((x, y), pose[2])
    hits = raycast.cast_along(section, pose[:2], in_world)
    hits = dataclasses.replace(hits, ray=jax.vmap(sensor.rays.centre)(jnp.arctan2(y, x)))
    light = dataclasses.replace(light, point=jnp.append(pose[:2], seconds))
    return sensor.read(key, hits, surfaces(arena, layout), light)


def _section(
    arena: Arena, data: mjx.Data, height: float, robot: Index, twin: Float[Array, "2"] | None
) -> raycast.CrossSection:
    """Cuts the scene at a height, without the robot that is looking, or with it as its twin."""
    if twin is None and is_static(robot):
        return raycast.cross_section(arena, data, height, int(robot))
    section = raycast.cross_section(arena, data, height, -1)
    is_own = (jnp.array(arena.robot_of_geom[list(section.geom)]) == robot)[:, None]
    if twin is None:
        # Rays never hit an outline of size 0.
        return dataclasses.replace(section, half=jnp.where(is_own, 0.0, section.half))
    moved = section.centre + (twin - robot_poses(data)[robot, :2])[None]
    return dataclasses.replace(section, centre=jnp.where(is_own, moved, section.centre))
