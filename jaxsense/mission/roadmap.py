"""Shortest paths to viewpoints, around the PoIs of an arena.

Robots do not know a PoI's shape before they have looked, so every PoI is a circle that holds all
shapes. A roadmap has some nodes around each circle and the lengths of the free paths between them;
the shortest path from anywhere to any viewpoint is then a minimum over two nodes. This is the part
of the paper's move_base that knows the map of the arena.
"""

import functools
import math

import chex
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxsense.config import Config, ConfigError
from jaxsense.config.mission import MARGIN, NODES_PER_POI, PLANNING_RADIUS, VIEW_SIDES
from jaxsense.core import checks
from jaxsense.core.types import Index, product, pytree
from jaxsense.sim import viewpoints
from jaxsense.sim.arena import Layout

VIEW_DISTANCES = 0.5, 0.9
"""Distances of viewpoints from a PoI, in metres, where it and its sensors allow them."""
_LEEWAY = 0.035  # m, within which of a node the next one stays in view
_MARGIN = 0.02  # m, extra distance of paths between nodes from PoIs
_SLACK = 1e-3  # m that a path may cut into an obstacle, because nodes touch their obstacle's circle


@pytree
class Roadmap:
    """Paths through one layout, with K nodes and V viewpoints of each PoI.

    Attributes:
      nodes: positions in metres.
      viewpoints: positions to look at a PoI from, in metres.
      between: length of the shortest path from each node to each other, in metres; 0 from a node
        to itself, infinite if there is none or a robot cannot stand at one of them.
      is_next: whether a path may lead straight from each node to each viewpoint; never to one
        that is not free.
      is_free: viewpoints with room for a robot and a view of the PoI.
      centres: of the PoIs, in metres.
      radius: minimum distance of a path's first part from the centres, in metres.
    """

    nodes: Float[Array, "K 2"]
    viewpoints: Float[Array, "N V 2"]
    between: Float[Array, "K K"]
    is_next: Bool[Array, "N V K"]
    is_free: Bool[Array, "N V"]
    centres: Float[Array, "N 2"]
    radius: Float[Array, ""]

    def lengths(
        self, position: Float[Array, "2"], poi: Index | slice = slice(None)
    ) -> Float[Array, "... V"]:
        """Lengths of the shortest paths to the viewpoints of one PoI, or of all.

        Ignores other robots: they will be elsewhere, or make room.

        Args:
          position: of a robot, in metres; if it is closer to a PoI than planning allows, paths lead
            away from the PoI.

        Returns:
          Metres; infinite where no path exists.
        """
        chex.assert_shape(position, (2,))
        is_free = self.is_free[poi]
        direct, to_node = self._first(position, self.viewpoints[poi].reshape(-1, 2))
        to_last, last = jnp.min(to_node[:, None] + self.between, axis=0), self.last(poi)
        around = jnp.min(jnp.broadcast_to(to_last, last.shape) + last, axis=-1)
        found = jnp.minimum(jnp.where(is_free, direct.reshape(is_free.shape), jnp.inf), around)
        return jnp.where(jnp.isposinf(found), jnp.inf, found)  # infinite without a gradient

    @property
    def leads(self) -> Bool[Array, "N K"]:
        """From which nodes a path leads to a viewpoint of each PoI."""
        is_last = jnp.any(self.is_next, axis=-2)
        # As a product, with numbers of paths: comparing all pairs takes many times as long.
        paths = jnp.isfinite(self.between).astype(jnp.float32)
        return product(is_last.astype(jnp.float32), paths.T) > 0

    def reaches(self, position: Float[Array, "2"], leads: Bool[Array, "N K"]) -> Bool[Array, " N"]:
        """Which PoIs have a path to a viewpoint, from `leads`: cheaper than `lengths`."""
        ends = jnp.concatenate([self.viewpoints.reshape(-1, 2), self.nodes])
        is_clear = _is_clear(position[None], ends, self.centres, self.radius)[0]
        direct, to_node = jnp.split(is_clear, [self.is_free.size])
        is_direct = jnp.any(direct.reshape(self.is_free.shape) & self.is_free, axis=-1)
        return is_direct | jnp.any(to_node[None] & leads, axis=-1)

    def last(
        self, poi: Index | slice = slice(None), view: Index | slice = slice(None)
    ) -> Float[Array, "... K"]:
        """Lengths of straight lines from the nodes to viewpoints, the last parts of paths.

        Returns:
          Metres; infinite where no path may lead straight.
        """
        places = self.viewpoints[poi, view][..., None, :]
        nodes = self.nodes.reshape(*[1] * (places.ndim - 2), -1, 2)
        apart = jnp.linalg.norm(places - nodes, axis=-1)
        return jnp.where(self.is_next[poi, view], apart, jnp.inf)

    def to_viewpoint(self, poi: Index, view: Index) -> Float[Array, " K"]:
        """Lengths of the shortest paths from the nodes to a viewpoint.

        Returns:
          Metres; infinite where there is none.
        """
        return jnp.min(self.between + self.last(poi, view)[None], axis=1)

    @jax.named_scope("mission.next_waypoint")
    def next_waypoint(
        self,
        to_view: Float[Array, " K"],
        position: Float[Array, "2"],
        others: Float[Array, "S 2"],
        poi: Index,
        view: Index,
    ) -> tuple[Float[Array, ""], Float[Array, "2"]]:
        """Finds length and first waypoint of the shortest path to one viewpoint.

        Args:
          to_view: see `to_viewpoint`.
          position: of a robot, in metres, see `lengths`.
          others: positions of standing robots, in metres, which cannot be waypoints.

        Returns:
          Length in metres, infinite if no path exists, and the waypoint, to which the straight line
          is free.
        """
        goal = self.viewpoints[poi, view][None]
        first = jnp.concatenate(self._first(position, goal))
        ends = jnp.concatenate([goal, self.nodes])
        apart = jnp.linalg.norm(ends[:, None] - others[None], axis=-1)
        is_taken = jnp.any(apart < 2 * PLANNING_RADIUS, axis=-1)
        # Of two nodes on one path the farther one, or a robot that has reached a node would stay.
        remaining = jnp.append(0.0, 1.001 * to_view)
        total = first + jnp.where(self.is_free[poi, view], remaining, jnp.inf)
        total = jnp.where(is_taken, jnp.inf, total)
        best = jnp.argmin(total)
        return total[best], ends[best]

    def _first(
        self, position: Float[Array, "2"], goals: Float[Array, "G 2"]
    ) -> tuple[Float[Array, " G"], Float[Array, " K"]]:
        """Lengths of free straight lines from a position to goals and to all nodes."""
        ends = jnp.concatenate([goals, self.nodes])
        length = _straight(position[None], ends, self.centres, self.radius)[0]
        return length[: len(goals)], length[len(goals) :]


def require_known_places(config: Config) -> None:
    """Raises `ConfigError` if robots have to find their way, or how many PoIs there are."""
    for name in ("inner_walls", "fewest_pois"):
        if (number := getattr(config.arena, name)) > 0:
            reason = "must be 0 where places are known; otherwise see jaxsense.exploration"
            raise ConfigError(f"arena.{name}", number, reason)


@checks.typed
def build(config: Config, layout: Layout) -> Roadmap:
    """Computes the viewpoints of a layout and the paths to them."""
    require_known_places(config)
    checks.require_shape("layout.position", layout.position, (config.arena.num_pois, 2))
    arena, centres = config.arena, layout.position
    radius = arena.poi_extent + PLANNING_RADIUS + _MARGIN
    sides = 2 * jnp.pi * jnp.arange(float(NODES_PER_POI)) / NODES_PER_POI
    # So far out that the paths between neighbours do not cut the circle.
    ring = (radius + _LEEWAY) / math.cos(math.pi / NODES_PER_POI)
    around = ring * jnp.stack([jnp.cos(sides), jnp.sin(sides)], axis=-1)
    nodes = (centres[:, None] + around[None]).reshape(-1, 2)
    reach = arena.side / 2 - PLANNING_RADIUS
    to_pois = jnp.linalg.norm(nodes[:, None] - centres[None], axis=-1)
    is_usable = jnp.all(to_pois >= radius, axis=-1) & (jnp.max(jnp.abs(nodes), axis=-1) <= reach)
    goals, is_free = _viewpoints(config, layout)
    edges = _straight(nodes, nodes, centres, radius)
    between = _shortest(jnp.where(is_usable[:, None] & is_usable[None], edges, jnp.inf))
    is_next = _is_clear(goals.reshape(-1, 2), nodes, centres, radius) & is_usable[None]
    is_next = is_next.reshape(*is_free.shape, -1) & is_free[..., None]
    return Roadmap(nodes, goals, between, is_next, is_free, centres, jnp.float32(radius - _MARGIN))


def _viewpoints(config: Config, layout: Layout) -> tuple[Float[Array, "N V 2"], Bool[Array, "N V"]]:
    """Positions around each PoI, and whether they are free and see it."""
    settings, num_pois = config.navigation, config.arena.num_pois
    sides = 2 * jnp.pi * jnp.arange(float(VIEW_SIDES)) / VIEW_SIDES
    nearest = config.viewpoint.min_distance + config.mission.localisation.search[0]
    nearest = jnp.maximum(config.arena.poi_extent + PLANNING_RADIUS, nearest)
    # Within the limits of a look also after rounding.
    margin = jnp.minimum(_MARGIN, (settings.view_range - nearest) / 4)
    limits = nearest + margin, settings.view_range - margin
    distances = jnp.clip(jnp.array(VIEW_DISTANCES), *limits)
    ring = jnp.stack([jnp.cos(sides), jnp.sin(sides)], axis=-1)
    offsets = (distances[:, None, None] * ring[None]).reshape(-1, 2)
    positions = layout.position[:, None] + offsets[None]

    def room(positions: jax.Array, poi: jax.Array) -> jax.Array:
        x, y = positions[:, 0], positions[:, 1]
        return viewpoints.free_room(x, y, MARGIN, config.arena, layout, jnp.zeros((0, 2)), poi)

    return positions, jax.vmap(room)(positions, jnp.arange(num_pois)) > 0


def _straight(
    start: Float[Array, "A 2"],
    end: Float[Array, "E 2"],
    centres: Float[Array, "N 2"],
    radius: Float[Array, ""] | float,
) -> Float[Array, "A E"]:
    """Lengths of straight lines between positions, infinite where they are not clear."""
    along_x, along_y = end[None, :, 0] - start[:, :1], end[None, :, 1] - start[:, 1:]
    is_clear = _is_clear(start, end, centres, radius)
    squared = along_x**2 + along_y**2
    is_same = squared == 0  # where a root has no gradient
    length = jnp.where(is_same, 0.0, jnp.sqrt(jnp.where(is_same, 1.0, squared)))
    return jnp.where(is_clear, length, jnp.inf)


def _is_clear(
    start: Float[Array, "A 2"],
    end: Float[Array, "E 2"],
    centres: Float[Array, "N 2"],
    radius: Float[Array, ""] | float,
) -> Bool[Array, "A E"]:
    """Whether straight lines between positions are clear of PoIs.

    A clear line keeps `radius` from all centres or, where it begins or ends closer, comes no closer
    in between.
    """

    def around(positions: jax.Array) -> tuple[jax.Array, ...]:
        """Coordinates relative to each centre, and the squared distance to keep, `[N, ...]`."""
        x = positions[None, :, 0] - centres[:, :1]
        y = positions[None, :, 1] - centres[:, 1:]
        kept = jnp.minimum(jnp.sqrt(x**2 + y**2), radius) - _SLACK
        return x, y, jnp.maximum(kept, 0.0) ** 2

    def keep_off(is_clear: jax.Array, ends: tuple[tuple[jax.Array, ...], tuple[jax.Array, ...]]):
        """Excludes lines that come too close to one centre."""
        from_x, from_y, from_kept = (x[:, None] for x in ends[0])
        to_x, to_y, to_kept = (x[None] for x in ends[1])
        along_x, along_y = to_x - from_x, to_y - from_y
        squared = along_x**2 + along_y**2
        ahead = -(from_x * along_x + from_y * along_y)
        beside = from_x * along_y - from_y * along_x
        # Otherwise it is closest at one of its ends.
        passes_by = (ahead > 0) & (ahead < squared)
        # Times the squared length of the line, which saves a division and a root.
        is_near = beside**2 < jnp.minimum(from_kept, to_kept) * squared
        return is_clear & ~(passes_by & is_near), None

    # All centres together exceed the cache, and unrolled they take long to compile.
    is_clear = jnp.ones((len(start), len(end)), bool)
    return jax.lax.scan(keep_off, is_clear, (around(start), around(end)), unroll=4)[0]


def _shortest(edges: Float[Array, "K K"]) -> Float[Array, "K K"]:
    """Lengths of the shortest paths over any number of nodes, given the lengths of edges.

    The method of Floyd (1962) and Warshall, with the nodes of one PoI at a time, which passes over
    the memory a tenth as often.
    """
    num_nodes = len(edges)

    def through(paths: jax.Array, first: jax.Array) -> tuple[jax.Array, None]:
        """Adds the paths through the nodes of one PoI."""
        enter = jax.lax.dynamic_slice(paths, (0, first), (num_nodes, NODES_PER_POI))
        leave = jax.lax.dynamic_slice(paths, (first, 0), (NODES_PER_POI, num_nodes))

        def go_on(node: jax.Array, leave: jax.Array) -> jax.Array:
            to_node = jax.lax.dynamic_slice(leave, (0, first + node), (NODES_PER_POI, 1))
            return jnp.minimum(leave, to_node + leave[node][None])

        leave = jax.lax.fori_loop(0, NODES_PER_POI, go_on, leave)
        sums = (enter[:, i, None] + leave[None, i] for i in range(NODES_PER_POI))
        return functools.reduce(jnp.minimum, sums, paths), None

    return jax.lax.scan(through, edges, jnp.arange(0, num_nodes, NODES_PER_POI))[0]
