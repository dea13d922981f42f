"""Robots that follow the next waypoint."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from roads import ALONE, CONFIG, EAST, FAR_AWAY, KEEP, OUTER, next_waypoint, planned

from jaxsense import sim
from jaxsense.mission import roadmap


@pytest.mark.parametrize("offset", [0.0, 0.034])
def test_a_robot_near_a_node_is_led_on_to_the_next(offset):
    # Up to 0.035 m from it, on any side, it sees the next one.
    plan = planned(ALONE, [[0.0, 0.0]])
    sides = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    nodes = plan[2].nodes[:, None]
    places = nodes + offset * jnp.stack([jnp.cos(sides), jnp.sin(sides)], axis=-1)[None]
    assert np.linalg.norm(places, axis=-1).min() > KEEP
    lead = functools.partial(next_waypoint, *plan)
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
        length = roadmap.lengths(CONFIG, layout, ways, start, poi)
        draws = jax.random.uniform(view_key, length.shape)
        view = jnp.argmax(jnp.where(jnp.isfinite(length), draws, -1.0))

        def step(place, _):
            left, waypoint = next_waypoint(CONFIG, layout, ways, place, FAR_AWAY, poi, view)
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
    args = *planned(ALONE, [[0.0, 0.0]]), jnp.array(start)
    length, place = next_waypoint(*args, FAR_AWAY, 0, OUTER + EAST)
    # Beyond it, where no other place of the way is near.
    other = place + offset * (place - args[3]) / jnp.linalg.norm(place - args[3])
    others = jnp.stack([FAR_AWAY[0], other])
    detour, aside = next_waypoint(*args, others, 0, OUTER + EAST)
    assert detour >= length
    if is_taken:
        assert np.linalg.norm(aside - other) >= 0.2 - 1e-6
        assert np.linalg.norm(aside - place) > 0.005
    else:
        np.testing.assert_array_equal(aside, place)


def test_a_robot_that_is_alone_has_a_next_waypoint():
    args = *planned(ALONE, [[0.0, 0.0]]), jnp.array([-1.0, 0.0])
    expected = next_waypoint(*args, FAR_AWAY, 0, OUTER + EAST)
    ours = next_waypoint(*args, jnp.zeros((0, 2)), 0, OUTER + EAST)
    np.testing.assert_array_equal(ours[0], expected[0])
    np.testing.assert_array_equal(ours[1], expected[1])
