import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.sparse import csgraph

from jaxsense.exploration import grid as grids

SIDE = 6.0  # 40 cells of .15 m
NOTHING, POSE = jnp.zeros((0, 3)), jnp.array([-1.5, 0.0, 0.0])
ANGLES = np.linspace(-np.pi, np.pi, 720, endpoint=False)
distances, way, with_view = map(jax.jit, (grids.distances, grids.way, grids.with_view))


@functools.partial(jax.jit, static_argnames="ignored")
def frontiers(grid, modality, paths, ignored=0.0):
    return grids.frontiers(grid, modality, paths, 4, ~grid.occupied, ignored)


@jax.jit
def scanned(grid, pose, ranges, ignore=NOTHING[:, :2]):
    return grids.with_scan(grid, pose, ANGLES, ranges, 5.0, ignore, 0, reach=2.0)


def two_rooms(door=4, seen=False):
    """A wall at x = .075 with a door of some cells at y = 0, all of it known."""
    evidence = jnp.full((40, 40), -1, jnp.int8).at[20].set(1)
    evidence = evidence.at[20, 20 - door // 2 : 20 + door // 2].set(-1)
    return grids.Grid(evidence, jnp.full((2, 40, 40), seen), jnp.zeros((2, 40, 40), bool), SIDE)


def ranges_at(pose, wall=np.inf):
    """Closed form: the arena, and a wall at x = `wall` where |y| > .4 m."""
    along = np.stack([np.cos(pose[2] + ANGLES), np.sin(pose[2] + ANGLES)]) + 1e-12
    depth = np.min((np.sign(along) * SIDE / 2 - pose[:2, None]) / along, axis=0)
    to_wall = (wall - pose[0]) / along[0]
    is_hit = (to_wall > 0) & (np.abs(pose[1] + to_wall * along[1]) > 0.4)
    return jnp.minimum(5.0, jnp.where(is_hit, jnp.minimum(depth, to_wall), depth))


@pytest.mark.parametrize("seed", range(4))
def test_distances_are_dijkstras(seed):
    rng, grid = np.random.default_rng(seed), two_rooms()
    grid = grid.replace(evidence=jnp.where(rng.random((40, 40)) < 0.05, 1, grid.evidence))
    circles = jnp.array([[1.0, 1.0, 0.5], [-2.0, 2.0, 0.3]])
    passable = np.array(grids.is_passable(grid, circles))
    near = np.any([np.roll(~passable, step, (0, 1)) for step in grids._AROUND], axis=0)
    half, edges = 0.075 * np.where(near, 4.0, 1.0), np.zeros((40, 40, 40, 40))
    for i, j in np.argwhere(passable):
        for k, m in np.add(grids._AROUND, (i, j)):
            if passable[k, m] and passable[k, j] and passable[i, m]:
                edges[i, j, k, m] = np.hypot(k - i, m - j) * (half[i, j] + half[k, m])
    i, j = start = np.argwhere(passable)[rng.integers(passable.sum())]
    expected = csgraph.dijkstra(edges.reshape(1600, 1600), indices=40 * i + j).reshape(40, 40)
    np.testing.assert_allclose(distances(grid, grid.centres[start], circles), expected, rtol=1e-5)
    assert np.isfinite(expected).sum() > 100


def test_a_path_leads_through_the_door_in_clear_straight_lines():
    grid, goal, start = two_rooms(), jnp.array([1.5, 2.0]), jnp.array([-1.5, 2.0])
    position, to_goal, driven = start, distances(grid, goal, NOTHING), 0.0
    # Twice hypot(1.5, 2) = 2.5 m, of which an 8-connected line takes at most 8.3 % more; some 45 cm
    # of it in the door count four times.
    assert 5.0 + 3 * 0.3 < to_goal[10, 33] < 5.6 + 3 * 0.45
    while (left := float(jnp.linalg.norm(position - goal))) > 0.11 and driven < 6:
        leg = way(grid, to_goal, position) - position
        assert 0 < jnp.linalg.norm(leg) <= 1.0
        assert grid.at(grid.free, position[None] + np.linspace(0, 1, 50)[:, None] * leg[None]).all()
        driven, position = driven + float(jnp.linalg.norm(leg)), position + leg
    assert left < 0.11 < driven < 5.6
    closed = distances(two_rooms(door=0), goal, NOTHING)
    np.testing.assert_array_equal(way(grid, closed, start), start)


def test_a_robot_boxed_in_reaches_only_its_box_and_leaves_a_margin():
    angles, grid = np.arange(8) * np.pi / 4, two_rooms()
    ring = np.stack([np.cos(angles) - 1.5, np.sin(angles), np.full(8, 0.35)], axis=-1)
    boxed = distances(grid, POSE[:2], ring)
    to_ring = np.min([grid.offsets(centre)[2] for centre in jnp.array(ring[:, :2])], axis=0)
    is_inside = (to_ring >= 0.45) & (grid.offsets(POSE[:2])[2] < 1)
    np.testing.assert_array_equal(jnp.isfinite(boxed), is_inside)
    # .3 m from the centre of a circle that keeps .45 m, and .7 m from the goal's cell.
    np.testing.assert_allclose(way(grid, boxed, jnp.array([-0.8, 0.0])), POSE[:2], atol=0.11)
    # From .6 m before one circle, the straight line passes it.
    around = distances(grid, jnp.array([-1.5, 2.0]), ring[:1] - np.array([[1, 0, 0]]))
    x, y = way(grid, around, jnp.array([-1.5, -0.6])) - np.array([-1.5, -0.6])
    assert 0.6 * jnp.abs(x) / jnp.hypot(x, y) > 0.45


def test_no_robot_stands_beside_a_wall():
    passable = np.array(grids.is_passable(two_rooms(), NOTHING))
    assert not passable[19:22, :17].any()
    assert passable[[18, 22], 1:39].all()
    assert passable[20, 19:21].all()
    assert not passable[20, [18, 21]].any()


def test_a_scan_draws_the_wall_and_sees_what_is_before_it():
    grid = scanned(grids.empty(SIDE, 2), POSE, ranges_at(POSE, wall=0.05))
    # The wall ends beams in column 20, 0 to .15 m, but for the gap; all before it is free.
    away = np.abs(grid.centres)
    assert grid.occupied[20, away > 0.5].mean() > 0.97
    assert not grid.occupied[:20].any()
    # Through the gap it sees y < .4 * (x + 1.5) / 1.55: .79 m in column 30, .44 in column 21.
    assert grid.free[30, away < 0.7].all()
    assert not (grid.free | grid.occupied)[21, away > 0.5].any()
    near = grid.free & (grid.offsets(POSE[:2])[2] <= 2.0)
    np.testing.assert_array_equal(grid.seen, [near, np.zeros((40, 40))])


def test_a_ghost_goes_away_and_a_known_body_leaves_none():
    clear, nothing = ranges_at(POSE), grids.empty(SIDE, 2)
    blocked = clear.at[np.abs(ANGLES) < 0.05].set(1.45)
    ghost = functools.reduce(lambda grid, _: scanned(grid, POSE, blocked), range(9), nothing)
    assert 1 <= ghost.occupied.sum() <= 2
    ghost = functools.reduce(lambda grid, _: scanned(grid, POSE, clear), range(5), ghost)
    assert not ghost.occupied.any()
    known = scanned(nothing, POSE, blocked, jnp.zeros((1, 2)))
    assert not known.occupied.any()
    assert known.seen[:, 20, 20].all()  # nothing else can be there
    assert scanned(nothing, POSE, jnp.full(720, jnp.nan)).free.sum() <= 1


def test_a_camera_sees_free_floor_in_its_view_up_to_walls():
    seen = with_view(two_rooms(), POSE, np.pi / 2, 3.0, 1).seen
    x, y, away = map(np.array, two_rooms().offsets(POSE[:2]))
    bearing = np.abs(np.arctan2(y, x))
    assert seen[1][(bearing < np.pi / 4 - 0.1) & (away < 2.9) & (x < 1.5)].all()
    assert not seen[1][((bearing > np.pi / 4) | (away > 3.0)) & (away > 0.1)].any()
    assert not seen[1][(x > 1.65) & (np.abs(y) > 0.4)].any()


def test_frontiers_lie_at_reachable_unseen_floor():
    # Unseen by both: 6 x 6 cells = .81 m2 in either room, and a long strip too narrow for a PoI.
    seen = jnp.ones((2, 40, 40), bool).at[:, 8, 2:20].set(False).at[1, 12:20].set(False)
    grid = two_rooms().replace(seen=seen.at[:, np.r_[5:11, 30:36], 30:36].set(False))
    paths = distances(grid, POSE[:2], NOTHING)
    found = frontiers(grid, 1, paths)
    np.testing.assert_array_equal(found.is_valid, [True, True, False, False])
    np.testing.assert_allclose(found.size, [0.81, 0.81, 0, 0], rtol=1e-5)
    np.testing.assert_allclose(found.position[:2], [[-1.8, 1.95], [1.95, 1.95]], atol=0.1)
    # What cameras have given up, LiDARs still may explore.
    given_up = grid.given_up.at[0, 5:11, 30:36].set(True)
    for modality, number in ((0, 1), (1, 2)):
        left = frontiers(grid.replace(given_up=given_up), modality, paths)
        assert left.is_valid.sum() == number
    # Of 1.62 m2, all or nothing is left.
    assert frontiers(grid, 1, paths, ignored=1.6).is_valid.sum() == 2
    assert frontiers(grid, 1, paths, ignored=1.7).is_valid.sum() == 0
    closed = frontiers(grid, 1, distances(two_rooms(door=0), POSE[:2], NOTHING))
    np.testing.assert_array_equal(closed.is_valid, [True, False, False, False])


def test_room_for_pois_as_worked_by_hand():
    # A wall in row 20: with a gap of two cells, one beside it and one at the border have no room.
    for gap, cells in ((0.3, 1), (0.1, 0)):
        expected = np.ones((40, 40), bool)
        expected[20 - cells : 21 + cells] = False
        border = [*range(cells), *range(40 - cells, 40)]
        expected[border] = expected[:, border] = False
        np.testing.assert_array_equal(grids.room(two_rooms(door=0), gap), expected)


def test_many_missions_equal_a_loop():
    def mission(pose):
        grid = scanned(grids.empty(SIDE, 2), pose, ranges_at(POSE, wall=0.05))
        grid = with_view(grid, pose, 1.4, 2.0, 1)
        paths = distances(grid, pose[:2], NOTHING)
        return grid, paths, way(grid, paths, jnp.zeros(2)), frontiers(grid, 1, paths)

    poses = POSE[None] + jnp.linspace(0, 0.5, 3)[:, None]
    singles = jax.tree.map(lambda *each: jnp.stack(each), *map(mission, poses))
    check = functools.partial(np.testing.assert_allclose, atol=1e-4)
    jax.tree.map(check, jax.vmap(mission)(poses), singles)
