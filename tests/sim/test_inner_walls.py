import jax
import jax.numpy as jnp
import numpy as np
import pytest
from arenas import natively_sized
from test_arena import driver, native_trajectory
from test_raycast import native_ray

from jaxsense import sim
from jaxsense.config.scene import CLEARANCE, ArenaConfig
from jaxsense.sim import arena as arenas
from jaxsense.sim import viewpoints

CONFIG = ArenaConfig(side=8.0, num_pois=12, inner_walls=5)
SMALL = ArenaConfig(num_pois=1, inner_walls=2)


def small_layout(wall, poi):
    """One wall, and one that is absent."""
    walls = jnp.array([wall, *arenas.absent_walls(1)])
    return sim.make_layout(SMALL, jnp.array([poi]), jnp.zeros(1), jnp.array([0]), walls)


@pytest.fixture(scope="module")
def layouts():
    draw = jax.jit(jax.vmap(lambda key: sim.random_layout(key, CONFIG, jnp.arange(12) % 3)))
    return jax.device_get(draw(jax.random.split(jax.random.key(0), 64)))


def test_drawn_walls_keep_their_gaps(layouts):
    centre, (yaw, half) = layouts.walls[..., :2], np.moveaxis(layouts.walls[..., 2:], -1, 0)
    present = half > 0
    assert present.sum(axis=1).mean() >= 4.8
    # Lengths are 0.25 to 0.55 of 8 m.
    np.testing.assert_allclose([half[present].min(), half[present].max()], [1.0, 2.2], atol=0.1)
    sides = np.stack([half, np.full_like(half, 0.025)], axis=-1)
    sides = np.where(yaw[..., None] > 1, sides[..., ::-1], sides)
    assert 4.0 - (np.abs(centre) + sides).max(axis=-1)[present].max() >= 0.6 - 1e-5
    beside = lambda places: np.abs(places[:, :, None] - centre[:, None]) - sides[:, None]  # noqa: E731
    length = lambda gaps: np.linalg.norm(np.maximum(gaps, 0.0), axis=-1)  # noqa: E731
    between = length(beside(centre) - sides[:, :, None])[:, ~np.eye(5, dtype=bool)]
    assert between.min() >= 0.6 - 1e-5
    assert length(beside(layouts.position)).min() >= 0.141421 + 0.3 - 1e-5


def test_the_number_of_pois_is_uniform():
    config = ArenaConfig(num_pois=5, fewest_pois=2)
    draw = jax.vmap(lambda key: sim.random_layout(key, config, jnp.zeros(5, jnp.int32)))
    layouts = jax.jit(draw)(jax.random.split(jax.random.key(1), 4000))
    is_inside = (np.abs(layouts.position) < 1.5).all(axis=-1)
    np.testing.assert_array_equal(layouts.present, is_inside)
    # 1000 each, with a standard deviation of sqrt(4000 * 3 / 16) = 27.
    np.testing.assert_allclose(np.bincount(is_inside.sum(axis=1)), [0, 0, *[1000] * 4], atol=110)


def test_rays_meet_inner_walls_as_those_of_mj_ray(layouts, set_native):
    arena, rng = arenas.build(CONFIG, (False,)), np.random.default_rng(0)

    @jax.jit
    def scan(layout, pose, angles):
        data = sim.place(arena, layout, pose)
        section = sim.cross_section(arenas.sized(arena, layout), data, 0.15, 0)
        return data, sim.cast(section, pose[0, :2], angles)

    met = 0
    for seed in range(8):
        layout = jax.tree.map(lambda x, s=seed: x[s].copy(), layouts)
        layout.walls[:, 2] += rng.uniform(-1, 1, 5)  # not along the sides
        draw = lambda *given: rng.uniform(*given).astype(np.float32)  # noqa: E731
        pose, angles = draw(-3.9, 3.9, (1, 3)), draw(-np.pi, np.pi, 400)
        data, hits = jax.device_get(scan(layout, pose, angles))
        native = natively_sized(arena, layout)
        given = native, set_native(data, of=native), pose[0, :2], 0.15
        expected, geom, _ = zip(*[native_ray(*given, a, robot=0) for a in angles], strict=True)
        np.testing.assert_allclose(hits.distance, expected, rtol=0, atol=1e-4)
        met += np.isin(geom, arena.inner_walls).sum()
    assert met > 500


def test_contacts_with_inner_walls_agree_with_c_mujoco():
    arena = arenas.build(SMALL, (False,), contacts=True)
    layout, speeds = small_layout([0.4, 0.1, 1.2, 0.35], [1.2, 1.2]), np.full((300, 1, 2), 7.0)
    start, states = driver(arena)(layout, jnp.zeros((1, 3)), speeds)
    expected = native_trajectory(natively_sized(arena, layout), start, speeds)
    for atol, ours, theirs in zip((5e-5, 5e-4), states, expected, strict=False):
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=atol)
    # They touch, and the wall gives way by some millimetres.
    assert 0.044 < arenas.room_beside(layout.walls, *states[0][:, :2].T).min() < 0.0495


def test_free_room_is_that_worked_by_hand():
    layout = small_layout([0.0, 0.0, 0.0, 0.5], [0.65, -0.5])  # 0.05 m thick
    x, y = jnp.array([[0.65, 0.2, -0.65, 0.65], [-1.0, -0.1, 0.5, 0.5]])
    room = viewpoints.free_room(x, y, CLEARANCE, SMALL, layout, jnp.zeros((0, 2)), 0)
    # From the PoI to the wall: hypot(0.15, 0.5 - 0.025) - 0.141421. Too near to the wall:
    # 0.1 - 0.025 - 0.0495 - 0.03. The view crosses it half-way: -0.025 - 0.5 * 0.141421. It passes
    # the end, nearest where the cone's side is parallel: 0.15 * sqrt(0.98) - 0.525 * 0.141421.
    np.testing.assert_allclose(room, [0.3567, -0.0045, -0.095711, 0.074246], atol=1e-3)
