import jax
import jax.numpy as jnp
import numpy as np
import pytest
from roads import (
    ALONE,
    CONFIG,
    EAST,
    FAR_AWAY,
    KEEP,
    MARGIN,
    NORTH,
    OUTER,
    SOUTH,
    WEST,
    lengths,
    next_waypoint,
    planned,
)
from scipy.sparse import csgraph

from jaxsense import sim
from jaxsense.config import ArenaConfig, Config, NavigationConfig
from jaxsense.mission import roadmap

WALLED_IN = Config(
    arena=ArenaConfig(num_pois=9, poi_gap=0.1), navigation=NavigationConfig(view_range=0.35)
)
# A ring of 8 PoIs that are 2 * 0.6 * sin 22.5 = 0.459 m apart: a robot needs 2 * 0.241421.
ANGLES = np.arange(8) * np.pi / 4
RING = np.concatenate([np.zeros((1, 2)), 0.6 * np.stack([np.cos(ANGLES), np.sin(ANGLES)], -1)])

reachable = jax.jit(roadmap.reachable, static_argnums=0)


@jax.jit
def last_parts(ways):
    """`[N, V, K]` lengths from nodes straight to viewpoints."""
    return jax.vmap(lambda poi: ways.last(poi, slice(None)))(jnp.arange(len(ways.viewpoints)))


@jax.jit
def to_viewpoints(ways):
    """`[N, V, K]` lengths from nodes to viewpoints."""
    of_views = jax.vmap(ways.to_viewpoint, (None, 0))
    pois, views = (jnp.arange(number) for number in ways.is_free.shape)
    return jax.vmap(of_views, (0, None))(pois, views)


def around_circle(start, end, centre, radius):
    """Shortest way around a circle: tangent, arc, tangent; and the angle of the arc, or 0."""
    start, end = start - centre, end - centre
    from_start, from_end = np.linalg.norm(start, axis=-1), np.linalg.norm(end, axis=-1)
    cosine = np.sum(start * end, axis=-1) / (from_start * from_end)
    arc = np.arccos(np.clip(cosine, -1, 1))
    arc = np.maximum(arc - np.arccos(radius / from_start) - np.arccos(radius / from_end), 0)
    tangents = np.sqrt(from_start**2 - radius**2) + np.sqrt(from_end**2 - radius**2)
    straight = np.linalg.norm(start - end, axis=-1)
    return np.where(arc > 0, tangents + radius * arc, straight), arc


@pytest.mark.parametrize("poi", [0, 1])
def test_viewpoints_lie_all_around_at_the_configured_distances(poi):
    config = Config()
    position = np.array([[0.3, -0.2], [-0.9, 0.9], [1.0, 1.0]])
    _, _, ways = planned(config, position)
    assert ways.viewpoints.shape == (3, 2 * 16, 2)
    away = np.array(ways.viewpoints[poi]) - position[poi]
    distance = np.linalg.norm(away, axis=-1).reshape(2, 16)
    expected = np.repeat([[0.5], [0.9]], 16, axis=1)
    np.testing.assert_allclose(distance, expected, atol=1e-6)
    # Every 360 / 16 = 22.5 degrees, from 0 to 337.5.
    side = np.degrees(np.arctan2(away[:, 1], away[:, 0])).reshape(2, 16)
    turned = (side - 22.5 * np.arange(16) + 180) % 360 - 180
    np.testing.assert_allclose(turned, 0, atol=1e-4)


@pytest.mark.parametrize(
    ("view", "goal", "length"),
    [
        (WEST, (-0.5, 0.0), 0.5),  # 0.3 east and 0.4 north: hypot = 0.5
        (OUTER + SOUTH, (0.0, -0.9), 0.943398),  # hypot(0.8, 0.5)
        # hypot(0.8, 0.9), past the PoI at a distance of |0.8 * 0.4 - 0.9 * 0.8| / 1.204 = 0.332.
        (NORTH, (0.0, 0.5), 1.204159),
    ],
)
def test_a_way_with_nothing_between_is_straight(view, goal, length):
    args = *planned(CONFIG, [[0.0, 0.0], [1.2, 1.2], [-1.2, 1.2]]), jnp.array([-0.8, -0.4])
    assert lengths(*args, 0)[view] == pytest.approx(length, abs=1e-5)
    way, place = next_waypoint(*args, FAR_AWAY, 0, view)
    assert way == pytest.approx(length, abs=1e-5)
    np.testing.assert_allclose(place, goal, atol=1e-6)


@pytest.mark.parametrize(("passes_at", "is_straight"), [(0.245, True), (0.237, False)])
def test_a_way_is_straight_if_it_keeps_the_planning_radius(passes_at, is_straight):
    # A line of 1.8 m from the viewpoint at (0.9, 0) that passes the PoI's centre at this distance;
    # the planning radius is 0.241421.
    sine = passes_at / 0.9
    start = jnp.array([0.9 - 1.8 * np.sqrt(1 - sine**2), 1.8 * sine])
    length, place = next_waypoint(*planned(ALONE, [[0.0, 0.0]]), start, FAR_AWAY, 0, OUTER + EAST)
    assert np.allclose(place, [0.9, 0.0], atol=1e-6) == is_straight
    assert length == pytest.approx(1.8, abs=1e-5) if is_straight else 1.8 < length < 1.81


@pytest.fixture(scope="module")
def around_one_poi():
    """Ways around a PoI at (0.2, -0.1) from random places: starts, goals and lengths `[S, V]`."""
    centre = np.array([0.2, -0.1])
    plan = planned(ALONE, centre[None])
    starts = np.random.default_rng(0).uniform(-1.4, 1.4, (200, 2)).astype(np.float32)
    starts = starts[np.linalg.norm(starts - centre, axis=-1) > KEEP + MARGIN]
    length = jax.vmap(lambda place: lengths(*plan, place, 0))(jnp.array(starts))
    ways = plan[2]
    is_free = np.array(ways.is_free[0])
    assert is_free.sum() >= 28
    goals = np.array(ways.viewpoints[0])[is_free]
    return starts[:, None], goals[None], centre, np.array(length)[:, is_free]


def test_no_way_around_a_poi_is_shorter_than_the_shortest(around_one_poi):
    *ends, length = around_one_poi
    shortest, _ = around_circle(*ends, KEEP)
    assert np.min(length - shortest) > -1e-4


def test_ways_around_a_poi_are_little_longer_than_the_shortest(around_one_poi):
    *ends, length = around_one_poi
    shortest, arc = around_circle(*ends, KEEP + MARGIN)
    bends = arc > 0
    straight = np.linalg.norm(ends[0] - ends[1], axis=-1)
    assert bends.sum() > 500
    # Half around a circle of 0.261, its polygon of ten nodes is 2 * 5 * 0.3117 * sin 18 = 0.963 m
    # instead of 0.821; on top come the straight parts, where there is nothing to lose.
    assert np.max(length[bends] / shortest[bends]) < 1.1
    assert np.mean(length[bends] / shortest[bends]) < 1.02
    np.testing.assert_allclose(length[~bends], straight[~bends], atol=1e-5)


def test_the_way_to_the_far_side_of_a_poi_is_longer_than_straight():
    args = *planned(ALONE, [[0.0, 0.0]]), jnp.array([-1.0, 0.0])
    length = lengths(*args, 0)[OUTER + EAST]
    # Tangents of sqrt(1 - 0.2414^2) = 0.9704 and sqrt(0.9^2 - 0.2414^2) = 0.8670, and an arc of
    # pi - acos(0.2414 / 1) - acos(0.2414 / 0.9) = 0.5154 rad at 0.2414: 0.1244. Straight is 1.9.
    assert 0.9704 + 0.8670 + 0.1244 - 1e-4 < length < 1.06 * 1.9618
    way, place = next_waypoint(*args, FAR_AWAY, 0, OUTER + EAST)
    assert way == pytest.approx(float(length), rel=1.1e-3)
    assert np.linalg.norm(place) > KEEP


@pytest.mark.parametrize(
    ("start", "shortest"),
    [
        # Tangents of sqrt(0.82 - 0.2414^2) = 0.8728 and sqrt(0.5^2 - 0.2414^2) = 0.4379, and an arc
        # of 2 pi - pi / 2 - atan 9 - acos(0.2414 / sqrt(0.82)) - acos(0.2414 / 0.5) = 0.8844 rad at
        # 0.2414: 0.2135. On the right, it would be 3.0309 - 1.3009 - 1.0669 = 0.6631 rad: 0.1601.
        ((1.28, -0.9), 0.8728 + 0.4379 + 0.2135),
        ((1.08, -0.9), 0.8728 + 0.4379 + 0.1601),
    ],
)
def test_no_way_leads_between_a_poi_and_a_wall_that_is_near(start, shortest):
    # To (1.18, 0.5) around a PoI at (1.18, 0). A robot's middle can go to 1.5 - 0.1 = 1.4 only,
    # which is 0.22 from the middle of the PoI.
    plan = planned(ALONE, [[1.18, 0.0]])
    way, place = next_waypoint(*plan, jnp.array(start), FAR_AWAY, 0, NORTH)
    assert place[0] < 1.18
    assert shortest - 1e-3 < way < 1.05 * shortest


@pytest.mark.parametrize(
    ("view", "low", "high"),
    [
        (WEST, 0.3, 0.3),  # straight out, 0.5 - 0.2
        # Straight through the middle it would be 0.5 + 0.2. By way of the node at 0.3117 on the
        # same side and half of the polygon, 0.1117 + 0.963, and from there 0.5 - 0.3117 = 0.188.
        (EAST, 0.7 + 0.1, 0.1117 + 0.963 + 0.189),
    ],
)
def test_a_robot_too_close_to_a_poi_leaves_it_and_does_not_cut_through(view, low, high):
    length = lengths(*planned(ALONE, [[0.0, 0.0]]), jnp.array([-0.2, 0.0]), 0)[view]
    assert low - 1e-5 <= length <= high + 1e-5


def test_a_viewpoint_close_to_another_poi_is_reached():
    # (0.5, 0), on the other side of PoI 0, is 0.25 from PoI 1: a robot needs 0.2414, and only on
    # the way between nodes 0.2614.
    plan = planned(CONFIG, [[0.0, 0.0], [0.75, 0.0], [-1.2, -1.2]])
    length = lengths(*plan, jnp.array([-0.8, 0.0]), 0)[EAST]
    shortest, _ = around_circle(np.array([-0.8, 0.0]), np.array([0.5, 0.0]), np.zeros(2), KEEP)
    assert shortest < length < 1.1 * shortest


@pytest.mark.parametrize("start", [(1.2, 0.0), (1.2, 1.2), (0.0, -1.3)])
def test_a_poi_in_a_ring_of_others_cannot_be_reached_from_outside(start):
    start = jnp.array(start)
    closed = planned(WALLED_IN, RING)
    assert np.all(closed[2].is_free[0])
    np.testing.assert_array_equal(lengths(*closed, start, 0), np.inf)
    length, _ = next_waypoint(*closed, start, FAR_AWAY, 0, 0)
    assert length == np.inf
    # One of the ring itself can be reached.
    assert np.isfinite(lengths(*closed, start, 1).min())
    # With that at 135 degrees moved away, there is a gap between (0, 0.6) and (-0.6, 0), from the
    # middle of which the way keeps less than 0.6 / sqrt(2) - 0.241421 = 0.183.
    opened = planned(WALLED_IN, [[-1.2, -1.2] if n == 4 else p for n, p in enumerate(RING)])
    gap = np.array([-0.3, 0.3])
    views = np.array(opened[2].viewpoints[0])
    through_gap = np.linalg.norm(start - gap) + np.linalg.norm(views - gap, axis=-1)
    length = lengths(*opened, start, 0)
    assert np.isfinite(length).all()
    assert np.all(length > through_gap - 2 * 0.183)


def test_within_a_ring_of_pois_there_are_ways():
    # 0.25 from the middle, with the viewpoint at 0.35 on the same side.
    length = lengths(*planned(WALLED_IN, RING), jnp.array([0.25, 0.0]), 0)
    assert length[EAST] == pytest.approx(0.1, abs=1e-5)
    assert np.isfinite(length).all()


def straight(starts, ends, centres, radius):
    """Lengths of straight ways, infinite where one comes closer to a centre than it may."""
    starts, ends, centres = (np.array(x, np.float64) for x in (starts, ends, centres))
    starts, ends = starts[:, None, None], ends[None, :, None]
    along, to_centre = ends - starts, centres - starts
    squared = np.maximum(np.sum(along**2, axis=-1), 1e-12)
    share = np.clip(np.sum(to_centre * along, axis=-1) / squared, 0, 1)
    apart = np.linalg.norm(to_centre - share[..., None] * along, axis=-1)
    at_ends = (np.linalg.norm(centres - place, axis=-1) for place in (starts, ends))
    is_free = np.all(apart >= np.minimum(np.minimum(*at_ends), radius) - 1e-3, axis=-1)
    return np.where(is_free, np.linalg.norm(along[:, :, 0], axis=-1), np.inf)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(
    "arena",
    [ArenaConfig(), ArenaConfig(num_pois=9, poi_gap=0.1), ArenaConfig(num_pois=16, side=6.0)],
    ids=["few", "walls of PoIs", "many"],
)
def test_ways_are_the_shortest_that_dijkstra_finds(arena, seed):
    config = Config(arena=arena)
    classes = jnp.zeros(arena.num_pois, jnp.int32)
    layout = sim.random_layout(jax.random.key(seed), arena, classes)
    _, _, ways = planned(config, layout.position)
    ways, centres = jax.tree.map(np.asarray, (ways, layout.position))
    nodes, places = ways.nodes, ways.viewpoints[ways.is_free]
    starts = np.concatenate([nodes, places])
    edges = straight(starts, nodes, centres, KEEP + MARGIN)
    has_room = np.linalg.norm(nodes[:, None] - centres[None], axis=-1).min(axis=-1) >= KEEP + MARGIN
    edges[:, ~has_room | (np.abs(nodes).max(axis=-1) > arena.side / 2 - 0.1)] = np.inf
    # Nobody goes to a viewpoint on the way to a node.
    graph = np.pad(edges, ((0, 0), (0, len(places))), constant_values=np.inf)
    graph = csgraph.csgraph_from_dense(graph, null_value=np.inf)
    shortest = csgraph.dijkstra(graph, indices=np.arange(len(nodes), len(starts)))
    assert np.isfinite(edges[: len(nodes)]).mean() < 0.7
    expected = shortest[:, : len(nodes)]
    between, last = ways.between, np.asarray(last_parts(ways))
    found = np.asarray(to_viewpoints(ways))[ways.is_free]
    np.testing.assert_allclose(found, expected, atol=1e-5)
    np.testing.assert_array_equal(last[~ways.is_free], np.inf)
    leads = np.isfinite(last[:, :, None] + between).any(axis=(1, 3))
    np.testing.assert_array_equal(ways.leads, leads)


def test_a_place_reaches_the_pois_with_a_way_of_finite_length():
    places = jax.random.uniform(jax.random.key(0), (100, 2), minval=-1.4, maxval=1.4)
    opened = [[-1.2, -1.2] if n == 4 else p for n, p in enumerate(RING)]
    shares = []
    for pois in (RING, opened):
        plan = planned(WALLED_IN, pois)
        each = jax.vmap(lambda place, poi, plan=plan: lengths(*plan, place, poi), in_axes=(None, 0))
        length = jax.vmap(each, in_axes=(0, None))(places, jnp.arange(9))
        expected = np.isfinite(length).any(axis=-1)
        found = jax.vmap(lambda place, plan=plan: reachable(*plan, place))(places)
        np.testing.assert_array_equal(found, expected)
        shares.append(expected[:, 0].mean())
    # Within the ring, and from nearly everywhere.
    assert 0.02 < shares[0] < 0.25
    assert shares[1] > 0.9


def test_a_place_with_no_node_in_sight_reaches_the_pois_around_it():
    # The ring is so narrow that all nodes in it are too close to a PoI: at 0.3117 m from the middle
    # and at most 18 degrees beside a PoI, sqrt(0.53^2 + 0.3117^2 - 0.3302 cos 18) = 0.2526 from it.
    # The viewpoint at 0.35 m and 22.5 degrees is 0.246 from two of them, which is enough.
    plan = planned(WALLED_IN, RING * 0.53 / 0.6)
    place = 0.3 * jnp.array([np.cos(np.pi / 8), np.sin(np.pi / 8)])
    reached = reachable(*plan, place)
    by_poi = jax.vmap(lambda poi: lengths(*plan, place, poi))(jnp.arange(9))
    np.testing.assert_array_equal(reached, np.isfinite(by_poi).any(axis=-1))
    # Those of the ring on its side have viewpoints beside it, those beyond the middle none.
    np.testing.assert_array_equal(np.flatnonzero(reached), [0, 1, 2, 3, 8])


@pytest.fixture(scope="module")
def beside_wall_and_poi():
    """PoI 0 at (1, 0), half a metre from the wall, and PoI 1 at (0.4, 0) west of it."""
    return planned(CONFIG, [[1.0, 0.0], [0.4, 0.0], [-1.2, -1.2]])


@pytest.mark.parametrize(
    ("view", "is_free"),
    [
        (NORTH, True),
        (OUTER + SOUTH, True),
        (EAST, False),  # (1.5, 0) is in the wall
        (OUTER + EAST, False),  # (1.9, 0) is behind it
        (WEST, False),  # (0.5, 0) is 0.1 from the middle of PoI 1
        (OUTER + WEST, False),  # (0.1, 0) has room, 0.3 from that, but PoI 1 covers PoI 0
    ],
)
def test_only_free_viewpoints_have_a_way(beside_wall_and_poi, view, is_free):
    ways = beside_wall_and_poi[2]
    here = ways.viewpoints[0, view]
    expected = 0.0 if is_free else np.inf
    assert ways.is_free[0, view] == is_free
    assert np.isinf(ways.last(0, view)).all() != is_free
    # Even from where it is.
    assert lengths(*beside_wall_and_poi, here, 0)[view] == expected
    length, place = next_waypoint(*beside_wall_and_poi, here, FAR_AWAY, 0, view)
    assert length == expected
    if is_free:
        np.testing.assert_array_equal(place, here)


@pytest.mark.parametrize(
    "call",
    [
        lambda plan, place: roadmap.lengths(*plan, place, 0),
        lambda plan, place: roadmap.reachable(*plan, place),
        lambda plan, place: next_waypoint(*plan, place, FAR_AWAY, 0, 0),
    ],
    ids=["lengths", "reachable", "next_waypoint"],
)
def test_a_wrong_shape_of_the_position_is_named_while_tracing(call):
    plan = planned(ALONE, [[0.0, 0.0]])
    jax.eval_shape(lambda place: call(plan, place), jnp.zeros(2))
    with pytest.raises(ValueError, match="position"):
        jax.eval_shape(lambda place: call(plan, place), jnp.zeros(3))


def test_lengths_of_paths_have_gradients():
    # From one side of a PoI to viewpoints of the next, around it.
    layout = sim.random_layout(jax.random.key(1), CONFIG.arena, jnp.array([0, 1, 2]))

    @jax.jit
    def shortest(positions, start):
        moved = layout.replace(position=positions)
        ways = roadmap.build(CONFIG, moved)
        return jnp.min(roadmap.lengths(CONFIG, moved, ways, start, 1))

    start, by = jnp.zeros(2), 2e-3
    found = jax.jit(jax.grad(shortest, (0, 1)))(layout.position, start)
    for argument, gradient in enumerate(found):
        arguments = [layout.position, start]
        measured = np.zeros(gradient.shape)
        for i in np.ndindex(gradient.shape):
            ends = []
            for step in (by, -by):
                moved = [*arguments]
                moved[argument] = arguments[argument].at[i].add(step)
                ends.append(float(shortest(*moved)))
            measured[i] = (ends[0] - ends[1]) / (2 * by)
        np.testing.assert_allclose(gradient, measured, atol=2e-3)
        assert np.abs(measured).max() > 0.5
    # At a node, where a path of no length begins, and where no path leads.
    ways = roadmap.build(CONFIG, layout)
    length = jax.jit(jax.grad(lambda x, ways: roadmap.lengths(CONFIG, layout, ways, x, 1).min()))
    assert np.isfinite(length(ways.nodes[0], ways)).all()
    nowhere = ways.replace(is_next=ways.is_next & False, is_free=ways.is_free & False)
    np.testing.assert_array_equal(length(start, nowhere), 0)
