"""Shortest ways around the PoIs of an arena to viewpoints.

A robot does not know a PoI's shape before it has looked, so every PoI is a circle that holds all
shapes. A roadmap has a few nodes around each circle and the lengths of the free ways between them;
a way from anywhere to any viewpoint is then a minimum over two of them. This is the part of the
paper's move_base that knows the map of the arena.
"""

import functools
import math

import chex
import jax
import jax.numpy as jnp

from jaxsense.config import NODES_PER_POI, VIEW_SIDES, Config
from jaxsense.core.types import pytree
from jaxsense.sim import viewpoints
from jaxsense.sim.arena import Layout

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
    places, is_free = _viewpoints(config, layout)
    starts = jnp.concatenate([nodes, places.reshape(-1, 2)])
    edges = _straight(starts, nodes, layout.position, radius)
    ways = _shortest(jnp.where(is_usable[None], edges, jnp.inf))
    to_viewpoint = ways[len(nodes) :].reshape(*is_free.shape, -1)
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


def reachable(config: Config, layout: Layout, roadmap: Roadmap, place: jax.Array) -> jax.Array:
    """Whether there is a way from a place to a viewpoint of each PoI, `[N]` bool; see `lengths`."""
    chex.assert_shape(place, (2,), custom_message="place")
    goals = roadmap.viewpoints.reshape(-1, 2)
    ends = jnp.concatenate([goals, roadmap.nodes])
    first = _straight(place[None], ends, layout.position, _radius(config) - _MARGIN)[0]
    is_seen = jnp.isfinite(first)
    direct = is_seen[: len(goals)].reshape(roadmap.is_free.shape) & roadmap.is_free
    leads_on = jnp.any(jnp.isfinite(roadmap.to_viewpoint), axis=1)
    around = is_seen[None, len(goals) :] & leads_on
    return jnp.any(direct, axis=-1) | jnp.any(around, axis=-1)


def next_waypoint(
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
    sides = 2 * jnp.pi * jnp.arange(VIEW_SIDES) / VIEW_SIDES
    distances = jnp.array(settings.view_distances)
    ring = jnp.stack([jnp.cos(sides), jnp.sin(sides)], axis=-1)
    offsets = (distances[:, None, None] * ring[None]).reshape(-1, 2)
    places = layout.position[:, None] + offsets[None]
    none = jnp.zeros((0, 2))

    def room(places: jax.Array, poi: jax.Array) -> jax.Array:
        x, y = places[:, 0], places[:, 1]
        return viewpoints.free_room(x, y, settings.margin, config.arena, layout, none, poi)

    return places, jax.vmap(room)(places, jnp.arange(num_pois)) > 0


def _straight(start: jax.Array, end: jax.Array, centres: jax.Array, radius: float) -> jax.Array:
    """Lengths `[A, B]` of straight ways between `[A, 2]` and `[B, 2]`, infinite where not free.

    A free way keeps `radius` from all `[N, 2]` centres or, where it begins or ends closer, comes no
    closer on the way.
    """

    def around(places: jax.Array) -> tuple[jax.Array, ...]:
        """Places as seen from each centre, and the squared distance to keep from it, `[N, ...]`."""
        x = places[None, :, 0] - centres[:, :1]
        y = places[None, :, 1] - centres[:, 1:]
        kept = jnp.minimum(jnp.sqrt(x**2 + y**2), radius) - _SLACK
        return x, y, jnp.maximum(kept, 0.0) ** 2

    def keep_off(is_free: jax.Array, ends: tuple[tuple[jax.Array, ...], tuple[jax.Array, ...]]):
        """Crosses off the ways that come too close to one centre."""
        from_x, from_y, from_kept = (x[:, None] for x in ends[0])
        to_x, to_y, to_kept = (x[None] for x in ends[1])
        along_x, along_y = to_x - from_x, to_y - from_y
        squared = along_x**2 + along_y**2
        ahead = -(from_x * along_x + from_y * along_y)
        beside = from_x * along_y - from_y * along_x
        # Elsewhere it is closest at one of its ends.
        passes_by = (ahead > 0) & (ahead < squared)
        # Times the squared length of the way, which saves a division and a root.
        is_near = beside**2 < jnp.minimum(from_kept, to_kept) * squared
        return is_free & ~(passes_by & is_near), None

    # All centres at once would not fit the cache, and to compile them one by one takes long.
    is_free = jnp.ones((len(start), len(end)), bool)
    is_free, _ = jax.lax.scan(keep_off, is_free, (around(start), around(end)))
    along_x, along_y = end[None, :, 0] - start[:, :1], end[None, :, 1] - start[:, 1:]
    return jnp.where(is_free, jnp.sqrt(along_x**2 + along_y**2), jnp.inf)


def _shortest(edges: jax.Array) -> jax.Array:
    """Lengths `[A, K]` of shortest ways over any number of nodes, from `[A, K]` single edges.

    The first K of the A starts are the nodes. The method of Floyd (1962) and Warshall, with the
    nodes of one PoI at a time, which passes over the memory a tenth as often.
    """
    num_starts, num_nodes = edges.shape

    def through(ways: jax.Array, first: jax.Array) -> tuple[jax.Array, None]:
        """Adds the ways through the nodes of one PoI."""
        enter = jax.lax.dynamic_slice(ways, (0, first), (num_starts, NODES_PER_POI))
        leave = jax.lax.dynamic_slice(ways, (first, 0), (NODES_PER_POI, num_nodes))

        def go_on(node: jax.Array, leave: jax.Array) -> jax.Array:
            to_node = jax.lax.dynamic_slice(leave, (0, first + node), (NODES_PER_POI, 1))
            return jnp.minimum(leave, to_node + leave[node][None])

        leave = jax.lax.fori_loop(0, NODES_PER_POI, go_on, leave)
        sums = (enter[:, i, None] + leave[None, i] for i in range(NODES_PER_POI))
        return functools.reduce(jnp.minimum, sums, ways), None

    return jax.lax.scan(through, edges, jnp.arange(0, num_nodes, NODES_PER_POI))[0]
