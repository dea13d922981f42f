"""Occupancy grid that all robots share: where they can drive, and what they have not seen.

Cell `[i, j]` of K x K lies at the i-th x and the j-th y, from the corner at x = y = -side / 2. The
outer walls are its border. Functions take one grid.
"""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int, Int8

from jaxsense.config.mission import PLANNING_RADIUS
from jaxsense.core.types import Index, product, pytree

Cells = Bool[Array, "K K"]
"""What holds for each cell."""
Lengths = Float[Array, "K K"]
"""Metres to each cell, infinite if it is not reachable."""
Place = Float[Array, "2"]
"""Coordinates x and y, in metres."""
Number = float | Float[Array, ""]
"""A number, which may be traced."""

CELL = 0.15
"""Largest side of a cell, in metres."""
LEAST_FRONTIER = 0.08
"""Unseen floor that makes a frontier, in square metres."""
_BODY, _UNDER = 0.2, 0.18  # m around robots and PoIs, of beams that end on them and hidden floor
# Metres behind the end of a beam, so that noise adds no cell in front of a wall, and around the
# centre of a cell that all beams cross if it is free.
_BEYOND, _CROSSED = 0.02, 0.05
_WIDTH = 0.2  # of a cell, least surface that beams measure in an occupied one: fewer are noise
_HIT, _MOST = 2, 4  # evidence of a scan in units of a crossing, and most evidence
_NEAREST = 0.45  # m to the cell that stands for a place in an obstacle's margin
_OBSTACLE_COST = 3.0  # of a length, next to cells that are not passable
_WAY, _CENTRED = 1.0, 0.05  # m to the farthest waypoint, and to a cell that a robot has reached
_SAMPLES, _BESIDE = 16, 0.08  # of a straight line, and m beside it that are free
_SPACING, _VIEW = 1.0, 0.75  # m between frontiers, and of the floor that belongs to one
_RAYS, _DEPTHS = 128, 32  # of a camera's view
_UNROLLED = 18  # rows: with fewer, an accelerator waits for each one
_AROUND = [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j]
_SIDES = [step for step in _AROUND if 0 in step]


@pytree
class Grid:
    """Occupancy grid of one arena.

    Attributes:
      evidence: that a cell is occupied: log-odds in units of one scan that crosses the cell; 0 if
        unknown.
      seen: floor where each of M modalities would have noticed a PoI.
      given_up: floor at which robots of each modality look no more.
      side: of the arena, in metres; static.
    """

    evidence: Int8[Array, "K K"]
    seen: Bool[Array, "M K K"]
    given_up: Bool[Array, "M K K"]
    side: float = struct.field(pytree_node=False)

    @property
    def free(self) -> Cells:
        """Floor that beams have crossed."""
        return self.evidence < 0

    @property
    def occupied(self) -> Cells:
        """Cells in which beams end."""
        return self.evidence > 0

    @property
    def cell(self) -> float:
        """Side of a cell, in metres."""
        return self.side / self.evidence.shape[-1]

    @property
    def centres(self) -> Float[np.ndarray, " K"]:
        """Coordinates of the cells, in metres; the same for x and y."""
        places = np.arange(self.evidence.shape[-1], dtype=np.float32) + 0.5
        return places * self.cell - self.side / 2

    def offsets(self, position: Place) -> tuple[Float[Array, "K K"], ...]:
        """Offsets x and y [m] of all cells from a position, and their distances [m]."""
        x, y = jnp.meshgrid(self.centres - position[0], self.centres - position[1], indexing="ij")
        return x, y, jnp.sqrt(x**2 + y**2)

    def index(self, positions: Float[Array, "*B 2"]) -> Int[Array, "*B"]:
        """Flat indices of the cells of positions, in metres; K * K outside of the arena."""
        number = len(self.centres)
        cells = jnp.floor((positions + self.side / 2) / self.cell)
        is_inside = jnp.all((cells >= 0) & (cells < number), axis=-1)
        index = jnp.where(is_inside, cells[..., 0] * number + cells[..., 1], number**2)
        return index.astype(jnp.int32)

    def at(self, cells: Cells, positions: Float[Array, "*B 2"]) -> Bool[Array, "*B"]:
        """What holds at positions, in metres; nothing outside of the arena."""
        return jnp.take(cells.ravel(), self.index(positions), mode="fill", fill_value=False)


@pytree
class Frontiers:
    """Places from which robots would see new floor, the most promising first.

    Attributes:
      position: in metres.
      heading: from there to the middle of the unseen floor, in radians.
      size: unseen floor near the place, in square metres.
      distance: to the place, in metres; infinite if it is none.
      is_valid: whether there is one; a place that is none has size 0.
    """

    position: Float[Array, "F 2"]
    heading: Float[Array, " F"]
    size: Float[Array, " F"]
    distance: Float[Array, " F"]
    is_valid: Bool[Array, " F"]


def num_cells(side: float) -> int:
    """Number of cells along a side of the arena, in metres."""
    return math.ceil(round(side / CELL, 6))


def empty(side: float, modalities: int) -> Grid:
    """The grid of an unknown arena."""
    evidence = jnp.zeros((num_cells(side),) * 2, jnp.int8)
    nothing = jnp.zeros((modalities, *evidence.shape), bool)
    return Grid(evidence, nothing, nothing, side)


def with_scan(
    grid: Grid,
    pose: Float[Array, "3"],
    angles: Float[np.ndarray, " B"],
    ranges: Float[Array, " B"],
    max_range: Number,
    ignore: Float[Array, "P 2"],
    modality: Index,
    reach: Number = math.inf,
) -> Grid:
    """Adds a LiDAR scan.

    A cell is crossed if the beams through its centre and on both sides go on behind it. The floor
    of known bodies counts as seen by all modalities, because nothing else can be there.

    Args:
      angles: of the beams in the robot's frame, in radians, equally spaced, at least two.
      ranges: in metres; NaN tells nothing.
      max_range: reading of a beam without a return, in metres.
      ignore: positions of bodies that are no obstacles of the grid: robots and PoIs, in metres.
      modality: that sees the floor.
      reach: to which it would notice a PoI, in metres.
    """
    spacing = float(angles[1] - angles[0])
    is_crossed, distance = _crossed(grid, pose, float(angles[0]), spacing, ranges)
    heading, depth = pose[2] + angles, (ranges + _BEYOND)[:, None]
    ends = pose[None, :2] + depth * jnp.stack([jnp.cos(heading), jnp.sin(heading)], axis=-1)
    to_body = jnp.sum((ends[:, None] - ignore[None]) ** 2, axis=-1)
    is_end = (ranges > 0) & (ranges < max_range) & jnp.all(to_body > _BODY**2, axis=-1)
    number = jnp.zeros(distance.size).at[grid.index(ends)].add(1.0 * is_end, mode="drop")
    is_hit = number.reshape(distance.shape) * distance * abs(spacing) > _WIDTH * grid.cell
    change = jnp.where(is_hit, _HIT, -is_crossed.astype(int))
    evidence = jnp.clip(grid.evidence + change, -_MOST, _MOST).astype(jnp.int8)
    seen = grid.seen.at[modality].set(grid.seen[modality] | (is_crossed & (distance <= reach)))
    is_known = _is_in(grid, ignore, jnp.full(len(ignore), _UNDER))
    return dataclasses.replace(grid, evidence=evidence, seen=seen | is_known[None])


def with_view(
    grid: Grid, pose: Float[Array, "3"], field_of_view: Number, reach: Number, modality: Index
) -> Grid:
    """Adds the free floor that a camera sees, with a line of sight over free floor.

    What no beam has crossed hides what is behind it: obstacles, PoIs and the unknown.

    Args:
      field_of_view: in radians.
      reach: to which the modality would notice a PoI, in metres.
    """
    shares, depth = np.linspace(-0.5, 0.5, _RAYS), reach * np.linspace(0, 1, _DEPTHS + 1)[1:]
    heading = pose[2] + field_of_view * shares
    ways = depth[None, :, None] * jnp.stack([jnp.cos(heading), jnp.sin(heading)], axis=-1)[:, None]
    is_open = grid.at(grid.free, pose[None, None, :2] + ways) | (depth < _UNDER)[None]
    ranges = jnp.min(jnp.where(is_open, jnp.inf, depth[None]), axis=1)
    first, spacing = -field_of_view / 2, field_of_view / (_RAYS - 1)
    is_crossed, distance = _crossed(grid, pose, first, spacing, ranges)
    is_seen = grid.seen[modality] | (is_crossed & grid.free & (distance <= reach))
    return dataclasses.replace(grid, seen=grid.seen.at[modality].set(is_seen))


def is_passable(grid: Grid, blocked: Float[Array, "P 3"]) -> Cells:
    """Free cells in which a robot can stand: the planning radius away from bodies and outer walls.

    Those beside occupied cells are none.

    Args:
      blocked: x, y and radius of other bodies, in metres, from whose outlines it keeps away, too.
    """
    is_in = _is_in(grid, blocked[:, :2], blocked[:, 2] + PLANNING_RADIUS)
    is_open = grid.free & ~_is_beside(grid.occupied, _SIDES)
    return is_open & (_to_outer_wall(grid) >= PLANNING_RADIUS) & ~is_in


def distances(grid: Grid, start: Place, blocked: Float[Array, "P 3"]) -> Lengths:
    """Lengths of the shortest 8-connected paths from a start over passable cells.

    Paths cut no corner, and count four times next to cells that are not passable. They are
    as long there as back. If the start is not passable, they begin at the nearest cell that is,
    up to .45 m away.

    Args:
      start: in metres.
      blocked: see `is_passable`.

    Returns:
      Metres; infinite where no path leads.
    """
    # Cells at the border are never passable: what is rolled over it does not count.
    passable = is_passable(grid, blocked)
    is_near = _is_beside(~passable, _AROUND)
    half = jnp.where(passable, grid.cell / 2 * (1 + _OBSTACLE_COST * is_near), jnp.inf)
    first, is_there = _nearest(grid, passable, start)
    begin = jnp.full(half.shape, jnp.inf).at[*first].set(jnp.where(is_there, 0.0, jnp.inf))
    halves = jnp.stack([jnp.rot90(half, turn) for turn in range(4)])

    def onward(before: jax.Array, at: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        (path, behind), (own, half) = before, at

        def aside(step: int) -> jax.Array:
            start, corner = jnp.roll(path + math.sqrt(2) * behind, step), jnp.roll(half, step)
            is_open = jnp.maximum(corner, behind) < jnp.inf
            return jnp.where(is_open, start + math.sqrt(2) * half, jnp.inf)

        path = jnp.minimum(jnp.minimum(own, path + behind + half), jnp.minimum(aside(1), aside(-1)))
        return jnp.stack([path, half]), path

    def sweep(paths: jax.Array, half: jax.Array) -> tuple[jax.Array, None]:
        """All paths that lead on from row to row, then a quarter turn."""
        outside = jnp.full_like(half[:2], jnp.inf)
        return jnp.rot90(jax.lax.scan(onward, outside, (paths, half), unroll=_UNROLLED)[1]), None

    # In all four directions: half the time of moving all cells at once by one step.
    def around(state: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        paths = jax.lax.scan(sweep, state[0], halves)[0]
        return paths, jnp.any(paths < state[0])

    return jax.lax.while_loop(lambda state: state[1], around, (begin, is_there))[0]


def way(grid: Grid, distances: Lengths, position: Place) -> Place:
    """Next waypoint of a robot on its shortest path.

    Args:
      distances: of all cells from the goal, in metres, see `distances`.
      position: of the robot, in metres.

    Returns:
      The farthest cell on the path, in metres, to which the straight line is clear, at most 1 m
      away; the position itself if the goal is not reachable.
    """
    passable, around = jnp.isfinite(distances), np.array(_AROUND)
    first, is_there = _nearest(grid, passable, position)
    steps = grid.cell * np.linalg.norm(around, axis=1).astype(np.float32)

    def descend(cell: jax.Array, _: None) -> tuple[jax.Array, jax.Array]:
        beside = cell[None] + around
        i, j = beside.T
        is_open = passable[i, cell[1]] & passable[cell[0], j]  # cuts no corner
        best = jnp.argmin(jnp.where(is_open, distances[i, j] + steps, jnp.inf))
        return (onward := jnp.where(distances[*cell] > 0, beside[best], cell)), onward

    _, cells = jax.lax.scan(descend, first, length=math.ceil(_WAY / grid.cell), unroll=True)
    ends = jnp.array(grid.centres)[jnp.concatenate([first[None], cells])]
    along = ends - position[None]
    length = jnp.sqrt(jnp.sum(along**2, axis=-1, keepdims=True))
    aside = _BESIDE * jnp.stack([-along[:, 1], along[:, 0]], axis=-1) / jnp.maximum(length, 1e-6)
    shares = np.linspace(0, 1, _SAMPLES, dtype=np.float32)
    middle, aside = position[None, None] + shares[None, :, None] * along[:, None], aside[:, None]
    is_clear = grid.at(passable, middle) & (length <= _WAY)
    is_clear &= grid.at(grid.free, middle - aside) & grid.at(grid.free, middle + aside)
    # The way out of an obstacle's margin is clear.
    is_clear = jnp.all(is_clear | (shares[None] * length <= length[:1]), axis=1)
    # At least the next cell from the centre of one, where the straight line is always free.
    last = jnp.max(jnp.where(is_clear, jnp.arange(len(ends)), length[0] < _CENTRED))
    return jnp.where(is_there, ends[last], position)


def room(grid: Grid, gap: float) -> Cells:
    """Cells where a PoI may stand, as far as known.

    Args:
      gap: from inner walls, in metres, and half of it from outer walls; static.
    """
    to_border = _to_outer_wall(grid)
    inner, near_wall = to_border > grid.cell, grid.occupied
    for _ in range(1, int(gap / grid.cell + 1e-6)):
        near_wall = _is_beside(near_wall & inner, _AROUND)
    return ~grid.occupied & ~near_wall & (to_border > gap / 2)


def frontiers(
    grid: Grid, modality: Index, distances: Lengths, number: int, room: Cells, ignored: float
) -> Frontiers:
    """Places next to floor that nobody has seen and this modality has not given up.

    Two by two cells of it must have room.

    One after the other, the reachable cell in or next to unseen floor with the most of it around,
    where near floor counts more, and no place before it within 1 m. Places with less than .08 m2
    within .75 m are none.

    Args:
      distances: of all cells from the robot, in metres, see `distances`.
      number: of places, static.
      room: floor that is worth seeing, see `room`.
      ignored: unseen floor up to which there is no place, in square metres.
    """
    unseen = _squares(room & ~jnp.any(grid.seen, axis=0) & ~grid.given_up[modality])
    reachable = jnp.isfinite(distances)
    cells, area = np.arange(len(distances)), grid.cell**2
    is_worth = area * jnp.sum(unseen) > ignored
    # Whole numbers, so that equal sums are equal everywhere.
    tent = np.maximum(round(_VIEW / grid.cell) - np.abs(np.subtract.outer(cells, cells)), 0)
    # Where a robot stands it sees at least that cell, or one beside it that it cannot enter.
    is_place = unseen | _is_beside(unseen & ~reachable, _SIDES)
    score = product(product(tent, unseen.astype(jnp.float32)), tent) * (is_place & reachable)

    def take(score: jax.Array, _: None) -> tuple[jax.Array, Frontiers]:
        i, j = jnp.unravel_index(jnp.argmax(score), score.shape)
        position = jnp.array(grid.centres)[jnp.stack([i, j])]
        x, y, away = grid.offsets(position)
        near = unseen & (away <= _VIEW)
        heading, size = jnp.arctan2(jnp.sum(y * near), jnp.sum(x * near)), jnp.sum(area * near)
        is_valid = (score[i, j] > 0) & (size >= LEAST_FRONTIER) & is_worth
        distance = jnp.where(is_valid, distances[i, j], jnp.inf)
        left = jnp.where(away < _SPACING, 0.0, score)
        return left, Frontiers(position, heading, size * is_valid, distance, is_valid)

    return jax.lax.scan(take, score, length=number, unroll=4)[1]


def _crossed(
    grid: Grid, pose: Float[Array, "3"], first: Number, spacing: Number, ranges: Float[Array, " B"]
) -> tuple[Cells, Lengths]:
    """Cells behind which equally spaced beams go on, also the robot's own, and their distances."""
    x, y, distance = grid.offsets(pose[:2])
    turn, beam = 2 * np.pi / abs(spacing), (jnp.arctan2(y, x) - pose[2] - first) / spacing
    aside = jnp.arcsin(jnp.minimum(_CROSSED / jnp.maximum(distance, _CROSSED), 1.0)) / abs(spacing)
    index = jnp.round(jnp.stack([beam - aside, beam, beam + aside]) % turn)
    index = jnp.where(index < jnp.round(turn), index, 0).astype(jnp.int32)
    goes_on = jnp.take(ranges, index, mode="clip") > distance[None] + _CROSSED
    is_crossed = jnp.all((index < len(ranges)) & goes_on, axis=0)
    return is_crossed | (distance < grid.cell / 2), distance


def _to_outer_wall(grid: Grid) -> Float[np.ndarray, "K K"]:
    """Distances of all cells from the nearest outer wall, in metres."""
    return grid.side / 2 - np.maximum.outer(np.abs(grid.centres), np.abs(grid.centres))


def _is_in(grid: Grid, centres: Float[Array, "P 2"], radii: Float[Array, " P"]) -> Cells:
    """Cells whose centres are in circles, in metres."""
    x, y = (grid.centres[None] - centres[:, axis, None] for axis in (0, 1))
    return jnp.any(x[:, :, None] ** 2 + y[:, None] ** 2 < radii[:, None, None] ** 2, axis=0)


def _squares(cells: Cells) -> Cells:
    """Cells in squares of two by two: a PoI of .1 m has no room in fewer."""
    padded = jnp.pad(cells, 1)
    rows = padded[1:] & padded[:-1]
    whole = rows[:, 1:] & rows[:, :-1]
    beside = whole[1:] | whole[:-1]
    return beside[:, 1:] | beside[:, :-1]


def _is_beside(cells: Cells, steps: list[tuple[int, int]]) -> Cells:
    """Whether cells are one of these steps away; on the border across the arena, too."""
    return jnp.any(jnp.stack([jnp.roll(cells, step, (0, 1)) for step in steps]), axis=0)


def _nearest(grid: Grid, cells: Cells, position: Place) -> tuple[Int[Array, "2"], Bool[Array, ""]]:
    """Indices of the cell nearest to a position, and whether there is one close by."""
    away = jnp.where(cells, grid.offsets(position)[2], jnp.inf)
    cell = jnp.stack(jnp.unravel_index(jnp.argmin(away), away.shape))
    return cell, away[cell[0], cell[1]] <= _NEAREST
