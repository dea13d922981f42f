import collections
import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from jaxsense import sim
from jaxsense.config.scene import LIDAR_HEIGHT, ArenaConfig
from jaxsense.sim import amiro, raycast

DISTANCE_TOLERANCE = 1e-4  # m
NORMAL_TOLERANCE = 1e-3
# At the camera and the LiDAR, between body and beams, above the PoIs, above the walls.
HEIGHTS = np.array([amiro.CAMERA_HEIGHT, LIDAR_HEIGHT, 0.12, 0.152, 0.25, 0.31], np.float32)
RAYS_PER_SCENE = 900
GEOM_GROUPS = np.array([1, 1, 0, 0, 0, 0], np.uint8)  # all but the invisible colliders


@pytest.fixture(scope="module")
def scan(arena):
    """Hits of `[S, B]` rays in S scenes, without one robot's own parts."""

    def scene(data, height, origins, angles, robot):
        section = sim.cross_section(arena, data, height, robot)
        return jax.vmap(sim.cast, in_axes=(None, 0, 0))(section, origins, angles)

    def scenes(*args, robot):
        return jax.vmap(functools.partial(scene, robot=robot))(*args)

    place = jax.jit(jax.vmap(lambda layout, poses: sim.place(arena, layout, poses)))
    cast = jax.jit(scenes, static_argnames="robot")

    def scan(layouts, poses, *rays, robot):
        data = place(layouts, poses)
        return jax.device_get((data, cast(data, *rays, robot=robot)))

    return scan


@pytest.fixture(scope="module")
def random_layouts():
    return jax.jit(jax.vmap(lambda key, c: sim.random_layout(key, ArenaConfig(), c)))


def at(tree, index):
    return jax.tree.map(lambda x: x[index], tree)


def is_free(points, layout_position, poses, excluded):
    to_poi = np.linalg.norm(points[:, None] - layout_position[None], axis=-1)
    to_robot = np.linalg.norm(points[:, None] - poses[None, :, :2], axis=-1)
    to_robot[:, excluded] = np.inf
    in_walls = np.abs(points).max(axis=-1)
    free = (to_poi > 0.1415).all(axis=-1) & (to_robot > 0.0495).all(axis=-1)
    return free & ((in_walls < 1.5) | (in_walls > 1.55))


def random_rays(rng, layout, robot):
    """Poses of the robots and rays in one scene: inside the arena, outside, and from the robot."""
    candidates = rng.uniform(-1.3, 1.3, (50, 2))
    is_clear = np.linalg.norm(candidates[:, None] - layout.position[None], axis=-1).min(-1) > 0.2
    poses = np.concatenate([candidates[is_clear][:2], rng.uniform(-4, 4, (2, 1))], axis=-1)
    inside = rng.uniform(-1.49, 1.49, (2 * RAYS_PER_SCENE, 2))
    outside = rng.uniform(-2.5, 2.5, (200, 2))
    origins = np.concatenate([outside[np.abs(outside).max(-1) > 1.56][:100], inside])
    excluded = [] if robot < 0 else [robot]
    origins = origins[is_free(origins, layout.position, poses, excluded)][:RAYS_PER_SCENE]
    if robot >= 0:
        origins[-300:] = poses[robot, :2]
    return poses, origins, rng.uniform(-np.pi, np.pi, RAYS_PER_SCENE)


def native_ray(arena, mj_data, origin, height, angle, robot):
    body = -1 if robot < 0 else arena.mj_model.body(f"robot{robot}").id
    geom, normal = np.full(1, -1, np.int32), np.zeros(3)
    start = np.array([*origin, height])
    direction = np.array([np.cos(angle), np.sin(angle), 0.0])
    distance = mujoco.mj_ray(
        arena.mj_model, mj_data, start, direction, GEOM_GROUPS, True, body, geom, normal
    )
    return distance, geom[0], normal


def distance_to_geom(arena, mj_data, geom, origin, height, angle):
    return mujoco.mju_rayGeom(
        mj_data.geom_xpos[geom],
        mj_data.geom_xmat[geom],
        arena.mj_model.geom_size[geom],
        np.array([*origin, height]),
        np.array([np.cos(angle), np.sin(angle), 0.0]),
        arena.mj_model.geom_type[geom],
    )


@pytest.fixture(scope="module")
def random_hits(arena, scan, random_layouts, set_native):
    """Rays of jaxsense and of C MuJoCo side by side: with and without robot 1, at six heights."""
    rng = np.random.default_rng(1)
    native, ours, rivals = [], [], []
    for robot in (-1, 1):
        keys = jax.random.split(jax.random.key(robot + 1), len(HEIGHTS))
        layouts = random_layouts(keys, rng.integers(0, 3, (len(HEIGHTS), 3)))
        layouts = jax.device_get(layouts)
        drawn = [random_rays(rng, at(layouts, s), robot) for s in range(len(HEIGHTS))]
        # The same float32 numbers for both sides.
        poses, origins, angles = (np.stack(x).astype(np.float32) for x in zip(*drawn, strict=True))
        data, hits = scan(layouts, poses, HEIGHTS, origins, angles, robot=robot)
        ours.append((hits.distance, hits.geom, np.stack(hits.normal, axis=-1)))
        for s, height in enumerate(HEIGHTS):
            mj_data = set_native(at(data, s))
            for origin, angle, geom in zip(origins[s], angles[s], hits.geom[s], strict=True):
                native.append(native_ray(arena, mj_data, origin, height, angle, robot))
                rivals.append(distance_to_geom(arena, mj_data, geom, origin, height, angle))
    distance, geom, normal = (np.array(x) for x in zip(*native, strict=True))
    ours = [np.concatenate(x).reshape(len(native), -1).squeeze() for x in zip(*ours, strict=True)]
    return ours, (np.where(geom < 0, np.inf, distance), geom, normal), np.array(rivals)


def kind_of(arena, geom):
    name = arena.mj_model.geom(geom).name if geom >= 0 else "nothing"
    return name.strip("0123456789") if name.startswith("wall") else name.rpartition("_")[2]


def test_random_rays_reach_every_kind_of_object_and_none(arena, random_hits):
    _, (_, geom, _), _ = random_hits
    assert len(geom) >= 10_000
    met = collections.Counter(kind_of(arena, g) for g in geom)
    assert set(met) == {"cylinder", "cube", "wall", "body", "lidar", "nothing"}
    assert min(met.values()) >= 25, met


def test_distances_are_those_of_mj_ray(random_hits):
    (distance, geom, _), (expected, expected_geom, _), _ = random_hits
    np.testing.assert_array_equal(geom >= 0, expected_geom >= 0)
    np.testing.assert_array_equal(np.isfinite(distance), geom >= 0)
    np.testing.assert_allclose(distance, expected, rtol=0, atol=DISTANCE_TOLERANCE)


def test_geoms_are_those_of_mj_ray_but_for_ties(random_hits):
    (_, geom, _), (distance, expected, _), rival = random_hits
    is_other = geom != expected
    # Only where two geoms are equally far: the walls overlap where they meet.
    np.testing.assert_allclose(rival[is_other], distance[is_other], rtol=0, atol=DISTANCE_TOLERANCE)
    assert is_other.mean() < 0.005


def test_normals_are_those_of_mj_ray_but_at_edges(random_hits):
    (_, geom, normal), (_, expected_geom, expected), _ = random_hits
    is_same = (geom == expected_geom) & (geom >= 0)
    error = np.abs(normal - expected[:, :2]).max(axis=-1)[is_same]
    # Where two sides of a box meet, rounding decides which one is hit.
    assert (error > NORMAL_TOLERANCE).mean() < 0.002
    length = np.linalg.norm(normal, axis=-1)
    np.testing.assert_allclose(length[geom >= 0], 1.0, atol=1e-3)
    np.testing.assert_array_equal(length[geom < 0], 0.0)


def test_turned_as_worked_by_hand():
    # A quarter turn to the left takes east to north, and north to west.
    x, y = raycast.turned((jnp.array([1.0, 0.0]), jnp.array([0.0, 1.0])), jnp.float32(np.pi / 2))
    np.testing.assert_allclose(x, [0.0, -1.0], atol=1e-6)
    np.testing.assert_allclose(y, [1.0, 0.0], atol=1e-6)
