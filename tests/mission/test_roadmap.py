import functools

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
from jaxsense.config import Config
from jaxsense.config.mission import NavigationConfig
from jaxsense.config.scene import ArenaConfig, ViewpointConfig
from jaxsense.mission import roadmap

WALLED_IN = Config(
    arena=ArenaConfig(num_pois=9, poi_gap=0.1), navigation=NavigationConfig(view_range=0.35)
)
# A ring of 8 PoIs that are 2 * 0.6 * sin 22.5 = 0.459 m apart: a robot needs 2 * 0.241421.
ANGLES = np.arange(8) * np.pi / 4
RING = np.concatenate([np.zeros((1, 2)), 0.6 * np.stack([np.cos(ANGLES), np.sin(ANGLES)], -1)])


@jax.jit
def to_viewpoints(ways):
    """`[N, V, K]` lengths from nodes to viewpoints."""
    of_views = jax.vmap(ways.to_viewpoint, (None, 0))
    pois, views = (jnp.arange(number) for number in ways.is_free.shape)
    return jax.vmap(of_views, (0, None))(pois, views)


# A look is from .6 to .64 m; viewpoints keep a quarter of the .04 m from either limit.
NARROW = Config(
    viewpoint=ViewpointConfig(min_distance=0.6), navigation=NavigationConfig(view_range=0.64)
)


@pytest.mark.parametrize(
    ("poi", "config", "distances"), [(0, CONFIG, (0.5, 0.9)), (1, NARROW, (0.61, 0.63))]
)
def test_viewpoints_lie_all_around_at_the_configured_distances(poi, config, distances):
    position = np.array([[0.3, -0.2], [-0.9, 0.9], [1.0, 1.0]])
    ways = planned(config, position)
    assert ways.viewpoints.shape == (3, 2 * 16, 2)
    away = np.array(ways.viewpoints[poi]) - position[poi]
    distance = np.linalg.norm(away, axis=-1).reshape(2, 16)
    np.testing.assert_allclose(distance.T, [distances] * 16, atol=1e-6)
    # Every 360 / 16 = 22.5 degrees, from 0 to 337.5.
    side = np.degrees(np.arctan2(away[:, 1], away[:, 0])).reshape(2, 16)
    turned = (side - 22.5 * np.arange(16) + 180) % 360 - 180
    np.testing.assert_allclose(turned, 0, atol=1e-4)


@pytest.mark.parametrize(("passes_at", "is_straight"), [(0.245, True), (0.237, False)])
def test_a_way_is_straight_if_it_keeps_the_planning_radius(passes_at, is_straight):
    # A line of 1.8 m from the viewpoint at (0.9, 0) that passes the PoI's centre at this distance;
    # the planning radius is 0.241421.
    sine = passes_at / 0.9
    start = jnp.array([0.9 - 1.8 * np.sqrt(1 - sine**2), 1.8 * sine])
    length, place = next_waypoint(planned(ALONE, [[0.0, 0.0]]), start, FAR_AWAY, 0, OUTER + EAST)
    assert np.allclose(place, [0.9, 0.0], atol=1e-6) == is_straight
    assert length == pytest.approx(1.8, abs=1e-5) if is_straight else 1.8 < length < 1.81


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


@pytest.mark.parametrize(
    "arena",
    [ArenaConfig(), ArenaConfig(num_pois=9, poi_gap=0.1), ArenaConfig(num_pois=16, side=6.0)],
    ids=["few", "walls of PoIs", "many"],
)
def test_ways_are_the_shortest_that_dijkstra_finds(arena):
    config = Config(arena=arena)
    classes = jnp.zeros(arena.num_pois, jnp.int32)
    layout = sim.random_layout(jax.random.key(1), arena, classes)
    ways = planned(config, layout.position)
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
    last = np.asarray(ways.last())
    found = np.asarray(to_viewpoints(ways))[ways.is_free]
    np.testing.assert_allclose(found, expected, atol=1e-5)
    np.testing.assert_array_equal(last[~ways.is_free], np.inf)


def test_a_place_reaches_the_pois_with_a_way_of_finite_length():
    places = jax.random.uniform(jax.random.key(0), (100, 2), minval=-1.4, maxval=1.4)
    opened = [[-1.2, -1.2] if n == 4 else p for n, p in enumerate(RING)]
    shares = []
    for pois in (RING, opened):
        plan = planned(WALLED_IN, pois)
        found = jax.vmap(lambda place, plan=plan: lengths(plan, place))(places)
        of_one = jax.vmap(lambda place, plan=plan: lengths(plan, place, 3))(places)
        np.testing.assert_array_equal(of_one, found[:, 3])
        shares.append(np.isfinite(found[:, 0]).any(axis=-1).mean())
    # Within the ring, and from nearly everywhere.
    assert 0.02 < shares[0] < 0.25
    assert shares[1] > 0.9


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
    ways = beside_wall_and_poi
    here = ways.viewpoints[0, view]
    expected = 0.0 if is_free else np.inf
    assert ways.is_free[0, view] == is_free
    assert np.isinf(ways.last(0, view)).all() != is_free
    # Even from where it is.
    assert lengths(beside_wall_and_poi, here, 0)[view] == expected
    length, place = next_waypoint(beside_wall_and_poi, here, FAR_AWAY, 0, view)
    assert length == expected
    if is_free:
        np.testing.assert_array_equal(place, here)


@pytest.mark.parametrize("offset", [0.0, 0.034])
def test_a_robot_near_a_node_is_led_on_to_the_next(offset):
    # Up to 0.035 m from it, on any side, it sees the next one.
    ways = planned(ALONE, [[0.0, 0.0]])
    sides = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    nodes = ways.nodes[:, None]
    places = nodes + offset * jnp.stack([jnp.cos(sides), jnp.sin(sides)], axis=-1)[None]
    assert np.linalg.norm(places, axis=-1).min() > KEEP
    lead = functools.partial(next_waypoint, ways)
    by_view = jax.vmap(lead, in_axes=(None, None, None, 0))
    by_place = jax.vmap(by_view, in_axes=(0, None, None, None))
    length, place = by_place(places.reshape(-1, 2), FAR_AWAY, 0, jnp.arange(2 * OUTER))
    assert np.isfinite(length).all()
    from_node = np.linalg.norm(place.reshape(10, 12, -1, 2) - nodes[:, :, None], axis=-1)
    assert from_node.min() > 0.1


@pytest.fixture(scope="module")
def followed():
    """Robots that go 2 cm at a time to what `next_waypoint` says, in 100 random arenas."""

    def follow(key):
        layout_key, class_key, place_key, poi_key, view_key = jax.random.split(key, 5)
        classes = jax.random.randint(class_key, (3,), 0, 3)
        layout = sim.random_layout(layout_key, CONFIG.arena, classes)
        ways = roadmap.build(CONFIG, layout)
        places = jax.random.uniform(place_key, (64, 2), minval=-1.4, maxval=1.4)
        apart = jnp.linalg.norm(places[:, None] - layout.position[None], axis=-1).min(axis=-1)
        start = places[jnp.argmax(apart >= KEEP)]
        poi = jax.random.randint(poi_key, (), 0, 3)
        length = ways.lengths(start, poi)
        draws = jax.random.uniform(view_key, length.shape)
        view = jnp.argmax(jnp.where(jnp.isfinite(length), draws, -1.0))

        def step(place, _):
            left, waypoint = next_waypoint(ways, place, FAR_AWAY, poi, view)
            away = waypoint - place
            share = jnp.minimum(0.02 / jnp.maximum(jnp.linalg.norm(away), 1e-9), 1.0)
            return place + share * away, (place, left)

        _, (path, left) = jax.lax.scan(step, start, length=250)
        return layout.position, ways.viewpoints[poi, view], length[view], path, left

    followed = jax.jit(jax.vmap(follow))(jax.random.split(jax.random.key(0), 100))
    return jax.tree.map(np.array, followed)


def test_following_the_next_waypoint_reaches_the_viewpoint_by_the_promised_way(followed):
    _, goal, length, path, left = followed
    assert np.isfinite(length).all()
    assert length.max() > 2.5
    away = np.linalg.norm(path - goal[:, None], axis=-1)
    assert away[:, -1].max() < 1e-5
    # One thousandth is what `next_waypoint` adds to prefer the farther of two nodes; the last
    # step is short.
    walked = 0.02 * (away > 1e-5).sum(axis=-1)
    assert np.all(walked <= 1.001 * length + 0.02 + 1e-4)
    np.testing.assert_allclose(left[:, 0], length, rtol=1.1e-3)
    # It gets shorter with every step.
    assert np.diff(left, axis=-1).max() < 1e-5


def test_following_the_next_waypoint_keeps_off_pois_and_walls(followed):
    position, _, _, path, _ = followed
    apart = np.linalg.norm(path[:, :, None] - position[:, None], axis=-1)
    assert apart.min() > KEEP - 2e-3
    # Ways do lead past PoIs, and that closely.
    assert (apart.min(axis=(1, 2)) < 0.32).sum() > 30
    assert np.abs(path).max() <= 1.5 - 0.1 + 1e-5


@pytest.mark.parametrize(("offset", "is_taken"), [(0.0, True), (0.19, True), (0.21, False)])
@pytest.mark.parametrize("start", [(-1.0, 0.0), (-0.4, -0.9), (0.95, -0.9)])
def test_the_next_waypoint_is_not_where_another_robot_stands(start, offset, is_taken):
    # From the first two a node is the next place to (0.9, 0), from the last one that itself.
    # Two robots with 0.1 each stand there if their middles are less than 0.2 apart.
    args = planned(ALONE, [[0.0, 0.0]]), jnp.array(start)
    length, place = next_waypoint(*args, FAR_AWAY, 0, OUTER + EAST)
    # Beyond it, where no other place of the way is near.
    other = place + offset * (place - args[1]) / jnp.linalg.norm(place - args[1])
    others = jnp.stack([FAR_AWAY[0], other])
    detour, aside = next_waypoint(*args, others, 0, OUTER + EAST)
    assert detour >= length
    if is_taken:
        assert np.linalg.norm(aside - other) >= 0.2 - 1e-6
        assert np.linalg.norm(aside - place) > 0.005
    else:
        np.testing.assert_array_equal(aside, place)
