"""Shortest ways around the PoIs of an arena to viewpoints.

A robot does not know a PoI's shape before it has looked, so every PoI is a circle that holds all
shapes. A roadmap has a few nodes around each circle and the lengths of the free ways between them;
a way from anywhere to any viewpoint is then a minimum over two of them. This is the part of the
paper's move_base that knows the map of the arena.
"""

import math

import chex
import jax
import jax.numpy as jnp

from jaxsense.config import NODES_PER_POI, Config
from jaxsense.sim import amiro, viewpoints
from jaxsense.sim.arena import Layout
from jaxsense.types import pytree

_LEEWAY = 0.035  # m, within which of a node the next one stays in view
_MARGIN = 0.02  # m, extra distance of ways between nodes from PoIs
_SLACK = 1e-3  # m, a way may cut an obstacle: nodes touch their own circle


@pytree
class Roadmap:
    """Ways through one layout. K nodes, N PoIs, V viewpoints for each PoI.

    Attributes:
      nodes: `[K, 2]` in metres.
      viewpoints: `[N, V, 2]` places to look at a PoI from, in metres.
      to_viewpoint: `[N, V, K]` length of the shortest way from each node to each viewpoint, in
        metres; infinite if there is none or the viewpoint is not free.
      is_free: `[N, V]` bool, viewpoints with room for a robot and a view of the PoI.
    """

    nodes: jax.Array
    viewpoints: jax.Array
    to_viewpoint: jax.Array
    is_free: jax.Array


def build(config: Config, layout: Layout) -> Roadmap:
    """Computes the ways and the viewpoints of a layout."""
    arena, settings = config.arena, config.navigation
    radius = _radius(config)
    sides = 2 * jnp.pi * jnp.arange(NODES_PER_POI) / NODES_PER_POI
    # So far out that the ways between neighbours do not cut the circle.
    ring = (radius + _LEEWAY) / math.cos(math.pi / NODES_PER_POI)
    around = ring * jnp.stack([jnp.cos(sides), jnp.sin(sides)], axis=-1)
    nodes = (layout.position[:, None] + around[None]).reshape(-1, 2)
    reach = arena.side / 2 - settings.robot_radius
    to_pois = jnp.linalg.norm(nodes[:, None] - layout.position[None], axis=-1)
    is_usable = jnp.all(to_pois >= radius, axis=-1) & (jnp.max(jnp.abs(nodes), axis=-1) <= reach)
    edges = _straight(nodes, nodes, layout.position, radius)
    between = _shortest(jnp.where(is_usable[:, None] & is_usable[None], edges, jnp.inf))

    places, is_free = _viewpoints(config, layout)
    last = _straight(places.reshape(-1, 2), nodes, layout.position, radius)
    to_places = _min_plus(jnp.where(is_usable[None], last, jnp.inf), between)
    to_viewpoint = to_places.reshape(*is_free.shape, -1)
    return Roadmap(nodes, places, jnp.where(is_free[..., None], to_viewpoint, jnp.inf), is_free)


def lengths(
    config: Config, layout: Layout, roadmap: Roadmap, place: jax.Array, poi: jax.Array
) -> jax.Array:
    """Lengths of the ways from a place to the viewpoints of a PoI, `[V]` metres; infinite for none.

    Ignores other robots: they will be elsewhere, or make room.

    Args:
      config: all settings.
      layout: where the PoIs stand.
      roadmap: of the layout.
      place: `[2]` in metres; may be closer to a PoI than planning allows, if the way leads away.
      poi: `[]` int32.
    """
    chex.assert_shape(place, (2,), custom_message="place")
    goals = roadmap.viewpoints[poi]
    ends = jnp.concatenate([goals, roadmap.nodes])
    first = _straight(place[None], ends, layout.position, _radius(config) - _MARGIN)[0]
    direct, to_node = first[: len(goals)], first[len(goals) :]
    around = jnp.min(to_node[None] + roadmap.to_viewpoint[poi], axis=-1)
    return jnp.minimum(jnp.where(roadmap.is_free[poi], direct, jnp.inf), around)


def next_place(
    config: Config,
    layout: Layout,
    roadmap: Roadmap,
    place: jax.Array,
    others: jax.Array,
    poi: jax.Array,
    view: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """Length and next place of the way to one viewpoint.

    Args:
      config: all settings.
      layout: where the PoIs stand.
      roadmap: of the layout.
      place: `[2]` in metres, see `lengths`.
      others: `[R', 2]` places of standing robots, in metres; the way does not begin at one.
      poi: `[]` int32.
      view: `[]` int32, one of the PoI's viewpoints.

    Returns:
      `[]` length, infinite if there is no way, and `[2]` the first place on it, to which a straight
      line is free.
    """
    chex.assert_shape(place, (2,), custom_message="place")
    ends = jnp.concatenate([roadmap.viewpoints[poi, view][None], roadmap.nodes])
    first = _straight(place[None], ends, layout.position, _radius(config) - _MARGIN)[0]
    apart = jnp.linalg.norm(ends[:, None] - others[None], axis=-1)
    is_taken = jnp.any(apart < 2 * config.navigation.robot_radius, axis=-1)
    # Of two nodes on one way the farther one, or a robot that has reached a node would stay there.
    remaining = jnp.append(0.0, 1.001 * roadmap.to_viewpoint[poi, view])
    total = first + jnp.where(roadmap.is_free[poi, view], remaining, jnp.inf)
    total = jnp.where(is_taken, jnp.inf, total)
    best = jnp.argmin(total)
    return total[best], ends[best]


def _radius(config: Config) -> float:
    """Distance of ways between nodes from the centres of PoIs, in metres."""
    return config.arena.poi_extent + config.navigation.robot_radius + _MARGIN


def _viewpoints(config: Config, layout: Layout) -> tuple[jax.Array, jax.Array]:
    """`[N, V, 2]` places around each PoI, and whether they are free and see it."""
    settings, num_pois = config.navigation, config.arena.num_pois
    sides = 2 * jnp.pi * jnp.arange(settings.view_sides) / settings.view_sides
    distances = jnp.array(settings.view_distances)
    ring = jnp.stack([jnp.cos(sides), jnp.sin(sides)], axis=-1)
    offsets = (distances[:, None, None] * ring[None]).reshape(-1, 2)
    places = layout.position[:, None] + offsets[None]
    none = jnp.zeros((0, 2))
    # Room for the planning radius, not only for the body.
    clearance = settings.robot_radius - amiro.BODY_RADIUS

    def room(places: jax.Array, poi: jax.Array) -> jax.Array:
        x, y = places[:, 0], places[:, 1]
        return viewpoints.free_room(x, y, clearance, config.arena, layout, none, poi)

    return places, jax.vmap(room)(places, jnp.arange(num_pois)) > 0


def _straight(start: jax.Array, end: jax.Array, centres: jax.Array, radius: float) -> jax.Array:
    """Lengths `[A, B]` of straight ways between `[A, 2]` and `[B, 2]`, infinite where not free.

    A free way keeps `radius` from all `[N, 2]` centres or, where it begins or ends closer, comes no
    closer on the way.
    """
    along = end[None] - start[:, None]
    is_free = jnp.ones(along.shape[:2], bool)
    for centre in centres:
        from_start = jnp.linalg.norm(start - centre[None], axis=-1)[:, None]
        from_end = jnp.linalg.norm(end - centre[None], axis=-1)[None]
        kept = jnp.minimum(jnp.minimum(from_start, from_end), radius)
        is_free &= _from_segments(start, end, centre) >= kept - _SLACK
    return jnp.where(is_free, jnp.linalg.norm(along, axis=-1), jnp.inf)


def _from_segments(start: jax.Array, end: jax.Array, point: jax.Array) -> jax.Array:
    """Distances `[A, B]` of a point from the straight ways between `[A, 2]` and `[B, 2]`."""
    start_x, start_y = start[:, None, 0], start[:, None, 1]
    along_x, along_y = end[None, :, 0] - start_x, end[None, :, 1] - start_y
    to_x, to_y = point[0] - start_x, point[1] - start_y
    squared = jnp.maximum(along_x**2 + along_y**2, 1e-12)
    share = jnp.clip((to_x * along_x + to_y * along_y) / squared, 0.0, 1.0)
    return jnp.hypot(to_x - share * along_x, to_y - share * along_y)


def _shortest(edges: jax.Array) -> jax.Array:
    """Lengths `[K, K]` of shortest ways over any number of nodes, from `[K, K]` single edges."""
    ways = jnp.where(jnp.eye(len(edges), dtype=bool), 0.0, edges)
    for _ in range(max(1, math.ceil(math.log2(len(edges))))):
        ways = _min_plus(ways, ways)
    return ways


def _min_plus(first: jax.Array, second: jax.Array) -> jax.Array:
    """Least sum over B of `[A, B]` and `[B, C]`, `[A, C]`."""
    return jax.lax.map(lambda row: jnp.min(row[:, None] + second, axis=0), first)
