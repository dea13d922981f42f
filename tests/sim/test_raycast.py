import collections
import functools

import chex
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx

from jaxsense import sim
from jaxsense.config import LIDAR_HEIGHT, ArenaConfig
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


@pytest.fixture(scope="module")
def known_scan(scan, known_layout):
    """Rays at the camera's height in the known layout; the robots stand far off, at (-1, -1)."""
    poses = jnp.array([[-1.0, -1.0, 0.0], [-1.0, -0.5, 0.0]])

    def cast(origins, angles):
        num = len(origins)
        batch = jax.tree.map(lambda x: jnp.repeat(x[None], len(HEIGHTS), 0), (known_layout, poses))
        pad = RAYS_PER_SCENE - num
        origins = np.pad(np.array(origins, np.float32), ((0, pad), (0, 0)))
        angles = np.pad(np.array(angles, np.float32), (0, pad))
        repeat = [np.repeat(x[None], len(HEIGHTS), 0) for x in (origins, angles)]
        data, hits = scan(*batch, HEIGHTS, *repeat, robot=-1)
        return at(data, 0), jax.tree.map(lambda x: np.array(x[0, :num]), hits)

    return cast


def test_hand_worked_hits(arena, known_scan):
    cos, sin = np.cos(np.radians(30)), 0.5
    cases = [
        # 0.06 beside the axis of a circle of 0.1: it is met 0.08 before its middle, 0.06^2 + 0.08^2
        # = 0.1^2, after 1 - 0.08 m, where the normal is (-0.08, 0.06) / 0.1.
        ((-1.0, 0.06), 0.0, 0.92, "poi0_cylinder", (-0.8, 0.6)),
        # Straight on to the side of a cube turned by 30 degrees, 0.5 - 0.1 m away.
        ((0.5 * cos, 1 + 0.5 * sin), np.radians(210), 0.4, "poi1_cube", (cos, sin)),
        # Along x on to the middle of that cube: its side crosses the ray 0.1 / cos 30 before it.
        ((-0.5, 1.0), 0.0, 0.5 - 0.1 / cos, "poi1_cube", (-cos, -sin)),
        # Down on to the wall at y = -1.5.
        ((0.0, -1.0), -np.pi / 2, 0.5, "wall3", (0.0, 1.0)),
        # From outside on to the outer side of the same wall, at y = -1.55.
        ((0.0, -2.0), np.pi / 2, 0.45, "wall3", (0.0, -1.0)),
        # The next robot's body, 1 - 0.0495 m away.
        ((-1.0, 0.5), -np.pi / 2, 0.9505, "robot1_body", (0.0, 1.0)),
    ]
    origins, angles, distance, names, normal = zip(*cases, strict=True)
    _, hits = known_scan(origins, angles)
    np.testing.assert_allclose(hits.distance, distance, atol=2e-6)
    assert [arena.mj_model.geom(g).name for g in hits.geom] == list(names)
    np.testing.assert_allclose(np.stack(hits.normal, -1), normal, atol=1e-5)


def test_ray_from_inside_a_geom_meets_it_where_it_leaves(arena, known_scan, set_native):
    cases = [
        # 0.06 beside the axis of a cylinder of 0.1 and 0.08 behind its middle: a chord of 0.16.
        ((-0.07, 0.06), 0.0, 0.15),
        ((0.0, 0.0), 1.0, 0.1),
        # From the middle of a cube along its diagonal: 0.1 times the square root of 2.
        ((1.0, -1.0), np.pi / 4, 0.1 * np.sqrt(2.0)),
        # In the middle of a wall 0.05 thick.
        ((0.0, 1.525), np.pi / 2, 0.025),
    ]
    origins, angles, distance = zip(*cases, strict=True)
    data, hits = known_scan(origins, angles)
    np.testing.assert_allclose(hits.distance, distance, atol=1e-5)
    mj_data = set_native(data)
    for origin, angle, own, geom in zip(origins, angles, hits.distance, hits.geom, strict=True):
        expected, expected_geom, _ = native_ray(arena, mj_data, origin, HEIGHTS[0], angle, -1)
        assert own == pytest.approx(expected, abs=DISTANCE_TOLERANCE)
        assert geom == expected_geom


def test_mjx_ray_sees_through_cylinders_and_cast_does_not(arena, known_scan):
    # mjx.ray raises TypeError on a model without a material.
    mj_model = mujoco.MjModel.from_xml_string("""
        <mujoco>
          <asset><material name="any"/></asset>
          <worldbody>
            <geom type="cylinder" size=".1 .1" pos="0 0 .1"/>
            <geom type="box" size=".025 1.5 .15" pos="1.525 0 .15"/>
          </worldbody>
        </mujoco>""")
    mj_data = mujoco.MjData(mj_model)
    mujoco.mj_kinematics(mj_model, mj_data)
    start, direction = np.array([-0.5, 0.0, HEIGHTS[0]]), np.array([1.0, 0.0, 0.0])
    geom = np.zeros(1, np.int32)
    native = mujoco.mj_ray(mj_model, mj_data, start, direction, None, True, -1, geom)
    assert native == pytest.approx(0.4)  # 0.5 to the axis, less the radius of 0.1

    model = mjx.put_model(mj_model, impl="jax")
    data = mjx.put_data(mj_model, mj_data, impl="jax")
    through, _ = jax.jit(mjx.ray)(model, data, jnp.array(start), jnp.array(direction))
    assert float(through) == pytest.approx(2.0, abs=1e-5)  # the wall at 1.5, behind the cylinder

    _, hits = known_scan([(-0.5, 0.0)], [0.0])
    assert hits.distance[0] == pytest.approx(0.4, abs=1e-5)
    assert arena.mj_model.geom(hits.geom[0]).name == "poi0_cylinder"


def test_batch_of_rays_equals_a_loop_of_singles(arena, known_scan):
    angles = np.linspace(-3.0, 3.0, 8, dtype=np.float32)
    origin = np.float32([-0.4, -0.3])
    data, batch = known_scan([origin] * len(angles), angles)
    section = sim.cross_section(arena, data, HEIGHTS[0], -1)
    cast = jax.jit(sim.cast)
    for b, angle in enumerate(angles):
        chex.assert_trees_all_close(at(batch, b), cast(section, origin, angle), atol=1e-5)
    several = cast(section, origin, angles.reshape(2, 4))
    assert several.geom.shape == several.distance.shape == (2, 4)
    chex.assert_trees_all_close(jax.tree.map(lambda x: x.reshape(-1), several), batch, atol=1e-5)


def test_wrong_shapes_are_named_while_tracing(arena, place, known_layout):
    data = place(known_layout, jnp.zeros((2, 3)))
    section = sim.cross_section(arena, data, 0.1, 0)
    with pytest.raises(ValueError, match="origin"):
        jax.eval_shape(sim.cast, section, jnp.zeros(3), jnp.float32(0))


def test_a_scene_has_outlines_and_no_more_circles_than_those(arena, place, known_layout):
    section = sim.cross_section(arena, place(known_layout, jnp.zeros((2, 3))), 0.1, 0)
    nothing = section.replace(geom=(), num_circles=0)
    with pytest.raises(ValueError, match=r"number of outlines = 0: must be .* greater than 0"):
        sim.cast(nothing, np.zeros(2), 0.0)
    number = len(section.geom)
    with pytest.raises(ValueError, match=rf"num_circles = {number + 1}: .* from 0 to {number}"):
        sim.cast(section.replace(num_circles=number + 1), np.zeros(2), 0.0)


def test_turned_as_worked_by_hand():
    # A quarter turn to the left takes east to north, and north to west.
    x, y = raycast.turned((jnp.array([1.0, 0.0]), jnp.array([0.0, 1.0])), jnp.float32(np.pi / 2))
    np.testing.assert_allclose(x, [0.0, -1.0], atol=1e-6)
    np.testing.assert_allclose(y, [1.0, 0.0], atol=1e-6)


def test_one_loop_and_two_find_the_same(arena, known_layout, place):
    """Accelerators use the one and CPUs the other."""
    data = place(known_layout, jnp.zeros((2, 3)))
    section = raycast.cross_section(arena, data, 0.152, 0)
    origins = jax.random.uniform(jax.random.key(0), (200, 2), minval=-1.4, maxval=1.4)
    angles = jax.random.uniform(jax.random.key(1), (200,), maxval=2 * jnp.pi)
    directions = jnp.cos(angles), jnp.sin(angles)
    one, two = (
        jax.jit(jax.vmap(find, in_axes=(None, 0, 0)))(section, origins, directions)
        for find in (raycast._nearest_by_one_loop, raycast._nearest_by_two_loops)
    )
    np.testing.assert_allclose(one[0], two[0], atol=1e-5)
    assert np.mean(np.asarray(one[1]) == two[1]) > 0.99  # grazing rays may differ
    assert len(np.unique(one[1])) > 4


@pytest.mark.parametrize("robot", [-2, 2, 3])
def test_a_robot_that_is_not_there_is_named(arena, robot):
    with pytest.raises(ValueError, match=f"robot = {robot}: must be -1 or one of the 2 robots"):
        raycast.cross_section(arena, arena.data, 0.1, robot)


def test_a_cross_section_holds_everything_that_is_seen_once(arena):
    section = raycast.cross_section(arena, arena.data, 0.1, 0)
    names = [arena.mj_model.geom(g).name for g in section.geom]
    pois = [f"poi{n}_{shape}" for shape in ("cylinder", "cube") for n in range(3)]
    walls = [f"wall{w}" for w in range(4)]
    assert sorted(names) == sorted([*pois, *walls, "robot1_body", "robot1_lidar"])
    assert section.num_circles == 4


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("half", np.ones((1, 2)), r"half has the shape \(1, 2\): must be \(2, 2\)"),
        ("axis", np.ones(2), r"axis has the shape \(2,\): must be \(2, 2\)"),
        ("centre", [[2.0, 0.0], [0.0, 0.0]], r"centre = .*: must be an array of shape \(2, 2\)"),
        ("centre", np.full((2, 2), np.nan), "centre = nan: must be finite"),
        ("half", np.full((2, 2), -0.5), "half = -0.5: must be 0 or more"),
        ("axis", np.array([[1.0, 0.0], [2.0, 0.0]]), "length of axis = 2.0: must be 1, also where"),
    ],
)
def test_what_is_no_scene_is_refused(name, value, expected):
    axis = np.array([[1.0, 0.0], [1.0, 0.0]])
    scene = sim.CrossSection(2 * axis, axis, np.full((2, 2), 0.5), (7, 3), 1)
    sim.cast(scene, np.zeros(2), 0.0)
    with pytest.raises(ValueError, match=expected):
        sim.cast(scene.replace(**{name: value}), np.zeros(2), 0.0)
    with pytest.raises(ValueError, match=r"geom = .*: must be a tuple"):
        scene.replace(geom=np.array([7, 3]))
