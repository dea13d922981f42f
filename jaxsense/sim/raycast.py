"""Directions of a sensor's rays, and an exact ray-caster for horizontal rays in an MJX state.

Everything that a sensor can see is an upright cylinder or box. At the height of a sensor the scene
is thus a set of circles and rectangles, whose intersections with a ray have a closed form.
"""

import dataclasses
import functools
from typing import Protocol

import chex
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float, Shaped
from mujoco import mjx

from jaxsense.core.types import pytree
from jaxsense.sim.arena import Arena

_VISIBLE_GROUP = 0

Direction = tuple[Float[Array | np.ndarray, "..."], Float[Array | np.ndarray, "..."]]
"""x and y of unit vectors, two arrays of the same shape."""

Origin = Float[Array | np.ndarray, "2"]
"""Start of rays, in metres."""


class Rays(Protocol):
    """Directions of B rays; frozen and hashable, static under `jit`."""

    @property
    def angles(self) -> Float[np.ndarray, "B"]:
        """Angles in the robot's frame, in radians, in the order of the readings."""
        ...

    def centre(self, bearing: Float[Array, ""]) -> Float[Array, ""]:
        """Real-valued index of the ray along a bearing, in radians."""
        ...


@dataclasses.dataclass(frozen=True)
class Fan:
    """Rays at equal angles, from right to left, around what is ahead.

    Attributes:
      num_rays: B.
      field_of_view: angle between the first and the last ray, in degrees.
    """

    num_rays: int
    field_of_view: float

    @property
    def angles(self) -> Float[np.ndarray, "B"]:
        """See `Rays.angles`."""
        half = float(np.radians(self.field_of_view)) / 2
        first = -half if self.num_rays > 1 else 0.0
        return np.linspace(first, half, self.num_rays, dtype=np.float32)

    def centre(self, bearing: Float[Array, ""]) -> Float[Array, ""]:
        """See `Rays.centre`."""
        step = float(np.radians(self.field_of_view)) / max(self.num_rays - 1, 1)
        return (bearing - self.angles[0]) / step


@dataclasses.dataclass(frozen=True)
class Pinhole:
    """Rays through the pixels of a pinhole camera's scanline, from left to right.

    Attributes:
      num_pixels: B.
      field_of_view: angle between the outer edges of the first and the last pixel, in degrees.
    """

    num_pixels: int
    field_of_view: float

    @property
    def _focal_length(self) -> float:
        return (self.num_pixels / 2) / float(np.tan(np.radians(self.field_of_view) / 2))

    @property
    def angles(self) -> Float[np.ndarray, "B"]:
        """See `Rays.angles`."""
        columns = np.arange(self.num_pixels)
        middle = (self.num_pixels - 1) / 2
        return np.arctan((middle - columns) / self._focal_length).astype(np.float32)

    def centre(self, bearing: Float[Array, ""]) -> Float[Array, ""]:
        """See `Rays.centre`."""
        return (self.num_pixels - 1) / 2 - self._focal_length * jnp.tan(bearing)


@pytree
class CrossSection:
    """Horizontal cross-section of a scene: O outlines, first all circles, then all rectangles.

    Attributes:
      centre: `[O, 2]` in metres.
      axis: `[O, 2]` unit vector along the first side.
      half: `[O, 2]` half the sides, in metres; a circle's radius twice; 0 if the plane does not cut
        the geom.
      geom: MuJoCo geom id of each outline.
      num_circles: number of circles.
    """

    centre: jax.Array
    axis: jax.Array
    half: jax.Array
    geom: tuple[int, ...] = struct.field(pytree_node=False)
    num_circles: int = struct.field(pytree_node=False)


@pytree
class Hit:
    """The first hit of a ray, `[...]` each.

    Attributes:
      distance: float32, in metres; infinite without a hit.
      geom: int32 MuJoCo geom id; -1 without a hit.
      normal: x and y, float32 each, of the surface's outward unit normal; 0 without a hit.
      ray: float32 index of the ray among all rays of the sensor; None until `sensors.scan` sets it.
    """

    distance: jax.Array
    geom: jax.Array
    normal: tuple[jax.Array, jax.Array]
    ray: jax.Array | None = None


def cross_section(
    arena: Arena, data: mjx.Data, height: Float[Array, ""] | float, robot: int
) -> CrossSection:
    """Computes the cross-section of a scene at a height above the floor, in metres.

    Wheels and casters are left out: at the height of a sensor they are inside the robot's cylinder.

    Args:
      arena: with inner walls `sized` for the layout.
      data: the arena's MJX state, with up-to-date `geom_xpos` and `geom_xmat`.
      robot: index of the robot whose geoms to omit, because it is looking; -1 for none.
    """
    if not -1 <= robot < arena.num_robots:
        raise ValueError(f"robot = {robot}: must be -1 or one of the {arena.num_robots} robots")
    model = arena.mj_model
    is_seen = (model.geom_group == _VISIBLE_GROUP) & ((robot < 0) | (arena.robot_of_geom != robot))
    cylinders, boxes = (
        tuple(np.flatnonzero(is_seen & (model.geom_type == kind)).tolist())
        for kind in (mjx.GeomType.CYLINDER, mjx.GeomType.BOX)
    )
    geoms = cylinders + boxes
    ids = jnp.array(geoms, jnp.int32)
    position, size = data.geom_xpos[ids], arena.model.geom_size[ids]
    is_circle = jnp.arange(len(geoms)) < len(cylinders)
    half_height = jnp.where(is_circle, size[:, 1], size[:, 2])
    half = jnp.where(is_circle[:, None], size[:, :1], size[:, :2])
    is_cut = jnp.abs(position[:, 2] - height) <= half_height
    return CrossSection(
        centre=position[:, :2],
        axis=data.geom_xmat[ids, :2, 0],
        half=jnp.where(is_cut[:, None], half, 0.0),
        geom=geoms,
        num_circles=len(cylinders),
    )


def cast(section: CrossSection, origin: Origin, angle: Float[Array | np.ndarray, "..."]) -> Hit:
    """First hits of rays from one position.

    A ray that starts inside a geom hits it from inside, as in MuJoCo's `mj_ray`.

    Distance and normal are differentiable in origin, angle and section, forwards and backwards. The
    derivatives are finite for every ray and 0 without a hit. They are exact wherever they exist,
    which is not at edges, on tangents and where two outlines are equally far away.

    Args:
      origin: start of the rays, in metres.
      angle: directions in the world, in radians.
    """
    return cast_along(section, origin, (jnp.cos(angle), jnp.sin(angle)))


def cast_along(section: CrossSection, origin: Origin, direction: Direction) -> Hit:
    """`cast` along unit vectors in the world; twice as fast if many calls share them."""
    chex.assert_shape(origin, (2,))
    chex.assert_equal_shape(direction)
    # Not by `platform_dependent`, which takes twice as long to trace and batch.
    on_cpu = jax.default_backend() == "cpu"
    nearest = _nearest_by_two_loops if on_cpu else _nearest_by_one_loop
    distance, outline = nearest(section, origin, direction)
    is_hit = outline < len(section.geom)
    geom = jnp.where(is_hit, choose(jnp.array(section.geom), outline), -1)
    # Infinity times a direction would have no derivative.
    finite = jnp.where(jnp.isfinite(distance), distance, 0.0)
    normal_x, normal_y = _normal(section, outline, origin, direction, finite)
    normal = jnp.where(is_hit, normal_x, 0.0), jnp.where(is_hit, normal_y, 0.0)
    return Hit(distance, geom, normal)


def turned(direction: Direction, yaw: Float[Array, ""]) -> Direction:
    """Turns vectors to the left by an angle, in radians."""
    x, y = direction
    cos, sin = jnp.cos(yaw), jnp.sin(yaw)
    return cos * x - sin * y, cos * y + sin * x


def choose(
    table: Shaped[Array | np.ndarray, "rows"], index: Shaped[Array, "*rays"]
) -> Shaped[Array, "*rays"]:
    """Returns `table[index]` by a chain of selects; an index that is no row chooses the first one.

    On CPUs this is ten times faster than a gather for a short table and many indices under `vmap`.
    The index may be whole floats.
    """
    chex.assert_rank(table, 1)
    return functools.reduce(
        lambda chosen, i: jnp.where(index == i, table[i], chosen), range(len(table)), table[0]
    )


def _distances(section: CrossSection, origin: Origin, direction: Direction) -> list[jax.Array]:
    """Distance to each outline, infinite without a hit."""
    return [
        (_to_circle if i < section.num_circles else _to_rectangle)(section, i, origin, direction)
        for i in range(len(section.geom))
    ]


def _to_circle(section: CrossSection, i: int, origin, direction) -> jax.Array:
    radius = section.half[i, 0]
    to_x = section.centre[i, 0] - origin[0]
    to_y = section.centre[i, 1] - origin[1]
    along = to_x * direction[0] + to_y * direction[1]
    # Uses the distance of the ray from the centre: the textbook discriminant cancels far away.
    across = to_x * direction[1] - to_y * direction[0]
    half_chord_squared = radius**2 - across**2
    is_cut = half_chord_squared > 0
    # The derivative of a square root is infinite at 0, and NaN once multiplied by 0.
    half_chord = jnp.sqrt(jnp.where(is_cut, half_chord_squared, 1.0))
    distance = jnp.where(along >= half_chord, along - half_chord, along + half_chord)
    return jnp.where(is_cut & (distance >= 0), distance, jnp.inf)


def _to_rectangle(section: CrossSection, i: int, origin, direction) -> jax.Array:
    cos, sin = section.axis[i, 0], section.axis[i, 1]
    from_x = origin[0] - section.centre[i, 0]
    from_y = origin[1] - section.centre[i, 1]

    def slab(position, speed, half):
        # A single division for both sides: it costs as much as all other operations.
        pace = 1.0 / jnp.where(jnp.abs(speed) < 1e-12, 1e-12, speed)
        middle, reach = -position * pace, jnp.abs(half * pace)
        return middle - reach, middle + reach

    u_speed = cos * direction[0] + sin * direction[1]
    v_speed = cos * direction[1] - sin * direction[0]
    u_in, u_out = slab(cos * from_x + sin * from_y, u_speed, section.half[i, 0])
    v_in, v_out = slab(cos * from_y - sin * from_x, v_speed, section.half[i, 1])
    enter, leave = jnp.maximum(u_in, v_in), jnp.minimum(u_out, v_out)
    is_met = (section.half[i, 0] > 0) & (enter <= leave) & (leave >= 0)
    return jnp.where(is_met, jnp.where(enter >= 0, enter, leave), jnp.inf)


def _nearest_by_one_loop(
    section: CrossSection, origin: Origin, direction: Direction
) -> tuple[jax.Array, jax.Array]:
    """Distance to a ray's first hit and index of the outline, float32; O without a hit."""
    distance, outline = jnp.float32(jnp.inf), jnp.float32(len(section.geom))
    for i, each in enumerate(_distances(section, origin, direction)):
        is_nearer = (each <= distance) & (each < jnp.inf)
        distance = jnp.where(is_nearer, each, distance)
        outline = jnp.where(is_nearer, jnp.float32(i), outline)
    return distance, outline


def _nearest_by_two_loops(
    section: CrossSection, origin: Origin, direction: Direction
) -> tuple[jax.Array, jax.Array]:
    """The same where XLA does not vectorise one loop with two results.

    The barrier keeps the compiler from merging the second loop, which finds the outline, with the
    first.
    """
    distance = functools.reduce(jnp.minimum, _distances(section, origin, direction))
    distances = _distances(*jax.lax.optimization_barrier((section, origin, direction)))
    nearest = functools.reduce(jnp.minimum, distances)
    squared_index = functools.reduce(
        lambda chosen, i: jnp.where((distances[i] <= nearest) & (nearest < jnp.inf), i**2, chosen),
        range(len(distances)),
        jnp.float32(len(distances) ** 2),
    )
    # XLA computes a square root once. Without it, the whole chain would be recomputed at every use
    # of the index, which is hundreds of times slower.
    return distance, jnp.round(jnp.sqrt(squared_index))


def _normal(
    section: CrossSection, outline: jax.Array, origin: Origin, direction: Direction, distance
) -> tuple[jax.Array, jax.Array]:
    """X and y of the outward unit normal where a ray hits an outline."""
    centre_x, centre_y, half_u, half_v, cos, sin = (
        choose(table[:, i], outline)
        for table in (section.centre, section.half, section.axis)
        for i in range(2)
    )
    offset_x = origin[0] + distance * direction[0] - centre_x
    offset_y = origin[1] + distance * direction[1] - centre_y
    along_u = offset_x * cos + offset_y * sin
    along_v = offset_y * cos - offset_x * sin
    on_u_side = jnp.abs(along_u) * half_v > jnp.abs(along_v) * half_u
    is_circle = outline < section.num_circles
    radius = jnp.maximum(half_u, 1e-9)
    box_x = jnp.where(on_u_side, jnp.sign(along_u) * cos, -jnp.sign(along_v) * sin)
    box_y = jnp.where(on_u_side, jnp.sign(along_u) * sin, jnp.sign(along_v) * cos)
    normal_x = jnp.where(is_circle, offset_x / radius, box_x)
    normal_y = jnp.where(is_circle, offset_y / radius, box_y)
    return normal_x, normal_y
