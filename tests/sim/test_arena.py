import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from jaxsense import sim
from jaxsense.config.scene import ArenaConfig
from jaxsense.sim import arena as arenas

STEPS = 200
TIMESTEP = 0.01  # s
FREE_TOLERANCE = 2e-5  # m, rad, m/s and rad/s, over 2 s of float32 against float64


def driver(arena):
    def run(layout, poses, wheel_speeds):
        def step(data, speeds):
            data = arenas.drive(arenas.sized(arena, layout), data, speeds)
            return data, (data.qpos, data.qvel, data.geom_xpos, data.geom_xmat)

        start = sim.place(arena, layout, poses)
        return start, jax.lax.scan(step, start, wheel_speeds)[1]

    jitted = jax.jit(run)

    def drive(*args):
        # MJX's own step promotes ranks.
        with jax.numpy_rank_promotion("allow"):
            return jax.tree.map(np.array, jitted(*args))

    return drive


def native_trajectory(arena, start, wheel_speeds):
    mj_data = mujoco.MjData(arena.mj_model)
    mj_data.mocap_pos[:], mj_data.mocap_quat[:] = start.mocap_pos, start.mocap_quat
    mj_data.qpos[:] = start.qpos
    states = []
    for speeds in wheel_speeds:
        # Left wheel, right wheel and the passive grip, for each robot.
        mj_data.ctrl[:] = np.concatenate([[*pair, 0.0] for pair in speeds])
        mujoco.mj_step(arena.mj_model, mj_data)
        xmat = mj_data.geom_xmat.reshape(-1, 3, 3)
        states.append([mj_data.qpos, mj_data.qvel, mj_data.geom_xpos, xmat])
        states[-1] = [x.copy() for x in states[-1]]
    return [np.stack(x) for x in zip(*states, strict=True)]


@pytest.fixture(scope="module")
def drive_freely(arena):
    return driver(arena)


@pytest.fixture(scope="module")
def contact_arena():
    return arenas.build(ArenaConfig(), (False, True), contacts=True)


@pytest.fixture(scope="module")
def drive_in_contact(contact_arena):
    return driver(contact_arena)


def test_place_shows_each_poi_once_in_its_shape_and_turns_it(arena, place):
    layout = sim.make_layout(
        ArenaConfig(),
        jnp.array([[0.5, -0.2], [-1.0, 0.3], [0.9, 1.1]]),
        jnp.array([0.0, 0.5, -1.2]),
        jnp.array([2, 0, 1]),  # red cube, green cylinder, red cylinder
    )
    data = place(layout, jnp.array([[0.1, -0.3, 0.7], [1.0, -1.0, -2.0]]))
    shown = {
        arena.mj_model.geom(g).name: np.array(data.geom_xpos[g])
        for g in range(arena.mj_model.ngeom)
        if arena.poi_of_geom[g] >= 0 and data.geom_xpos[g, 2] > 0
    }
    # A PoI is 0.2 high and stands on the floor.
    assert shown.keys() == {"poi0_cube", "poi1_cylinder", "poi2_cylinder"}
    np.testing.assert_allclose(shown["poi0_cube"], [0.5, -0.2, 0.1], atol=1e-6)
    np.testing.assert_allclose(shown["poi2_cylinder"], [0.9, 1.1, 0.1], atol=1e-6)
    first_side = data.geom_xmat[arena.mj_model.geom("poi1_cylinder").id][:, 0]
    np.testing.assert_allclose(first_side, [np.cos(0.5), np.sin(0.5), 0.0], atol=1e-6)
    np.testing.assert_allclose(arenas.robot_poses(data)[1], [1.0, -1.0, -2.0])
    # The LiDAR's box is 0.094 to 0.164 m above the floor: its beams at 0.152 leave from within.
    lidar = data.geom_xpos[arena.mj_model.geom("robot1_lidar").id]
    np.testing.assert_allclose(lidar, [1.0, -1.0, 0.129], atol=1e-6)


def test_robot_has_the_urdf_sizes_and_mass(arena):
    body = arena.mj_model.geom("robot0_body")
    np.testing.assert_allclose(body.size[:2], [0.099 / 2, 0.084 / 2])
    np.testing.assert_allclose(body.pos, [0, 0, 0.010 + 0.084 / 2])
    left, right = (arena.mj_model.geom(f"robot0_{side}_wheel") for side in ("left", "right"))
    np.testing.assert_allclose(left.size[:2], [0.05571 / 2, 0.006 / 2])
    np.testing.assert_allclose(left.pos - right.pos, [0, 0.069, 0], atol=1e-9)
    # The box of the laser scanner, .094 to .164 m above the floor.
    np.testing.assert_allclose(arena.mj_model.geom("robot1_lidar").size[2], 0.035)
    assert arena.mj_model.body("robot0").mass == pytest.approx(0.4 + 2 * 0.02)


def test_free_trajectory_agrees_with_c_mujoco(arena, drive_freely, known_layout):
    rng = np.random.default_rng(0)
    # Full range, ten different commands: the servos saturate after each change.
    speeds = np.repeat(rng.uniform(-8, 8, (10, 2, 2)), STEPS // 10, axis=0).astype(np.float32)
    poses = jnp.array([[-0.5, 0.1, 0.3], [0.5, -0.4, -2.0]])
    start, states = drive_freely(known_layout, poses, speeds)
    expected = native_trajectory(arena, start, speeds)
    for name, ours, theirs in zip(("qpos", "qvel", "xpos", "xmat"), states, expected, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=FREE_TOLERANCE, err_msg=name)
    assert np.abs(expected[1]).max(axis=0).min() > 0.1  # they did move


@pytest.fixture(scope="module")
def ahead_and_turning(drive_freely, known_layout):
    """Robot 0 is told to drive straight at 5 rad/s, robot 1 to turn on the spot at 2 rad/s."""
    speeds = np.tile(np.float32([[5.0, 5.0], [-2.0, 2.0]]), (STEPS, 1, 1))
    poses = jnp.array([[-1.0, -0.8, np.pi / 6], [0.5, 0.5, 0.0]])
    _, (qpos, qvel, *_) = drive_freely(known_layout, poses, speeds)
    return qpos, qvel


def test_acceleration_reaches_its_limit_and_no_more(ahead_and_turning):
    _, qvel = ahead_and_turning
    speed = np.concatenate([[0.0], qvel[:, :2] @ [np.cos(np.pi / 6), 0.5]])
    acceleration = np.diff(speed) / TIMESTEP
    assert acceleration.max() == pytest.approx(2.5, rel=0.02)
    # 0.139 m/s take 0.056 s at 2.5 m/s^2; the last part is slower, five time constants of 0.02 s.
    assert speed[16] > 0.99 * 0.139275
    assert speed.max() <= 0.139275 + 1e-5


def test_a_curve_is_a_circle_of_the_commanded_radius(drive_freely, known_layout):
    # (4 + 6) / 2 * 0.027855 = 0.139275 m/s and (6 - 4) * 0.027855 / 0.069 = 0.807391 rad/s: after
    # 2 s, 1.61 rad of a circle of 0.1725 m. Starting up takes it a little longer, and it drifts
    # outwards at 0.139 * 0.807 m/s^2 for the grip's time constant of 0.02 s: 0.0022 m/s.
    speeds = np.tile(np.float32([[4.0, 6.0], [6.0, 4.0]]), (STEPS, 1, 1))
    _, (qpos, qvel, *_) = drive_freely(known_layout, jnp.zeros((2, 3)), speeds)
    yaw, velocity = qpos[:, 2], qvel[:, :2]
    forward = velocity[:, 0] * np.cos(yaw) + velocity[:, 1] * np.sin(yaw)
    sideways = velocity[:, 1] * np.cos(yaw) - velocity[:, 0] * np.sin(yaw)
    assert forward[-1] == pytest.approx(0.139275, abs=5e-4)
    assert qvel[-1, 2] == pytest.approx(0.807391, abs=2e-3)
    assert sideways[-1] == pytest.approx(-0.00225, abs=3e-4)
    # Left and right are mirror images.
    np.testing.assert_allclose(qpos[:, :3], qpos[:, 3:] * [1, -1, -1], atol=1e-5)


def test_random_layout_keeps_the_gaps():
    for num_pois, seeds in ((3, 300), (8, 200)):
        config = ArenaConfig(num_pois=num_pois)
        classes = jnp.zeros(num_pois, jnp.int32)
        layouts = jax.jit(jax.vmap(lambda k, c=config, z=classes: sim.random_layout(k, c, z)))(
            jax.random.split(jax.random.key(num_pois), seeds)
        )
        position = np.array(layouts.position)
        between = np.linalg.norm(position[:, :, None] - position[:, None], axis=-1)
        between[:, range(num_pois), range(num_pois)] = np.inf
        # A cube of half side 0.1 reaches 0.141421 from its centre: 0.3 m are free beyond that
        # between two PoIs, and half of it to a wall at 1.5.
        assert between.min() >= 2 * 0.141421 + 0.3 - 1e-5
        assert np.abs(position).max() <= 1.5 - 0.141421 - 0.15 + 1e-5
        # Everything that may be used is used: every quadrant by every slot, every direction.
        quadrant = (position[..., 0] > 0) * 2 + (position[..., 1] > 0)
        assert all(set(quadrant[:, n]) == {0, 1, 2, 3} for n in range(num_pois))
        yaw = np.sort(np.array(layouts.yaw).ravel())
        assert yaw[0] < -3.0
        assert yaw[-1] > 3.0


def test_as_many_pois_as_the_config_accepts_can_be_placed():
    # A pitch of 2 * 0.070711 + 0.058579 = 0.2 m: 5 * 5 PoIs, to the last bit, fit a side of 1 m.
    config = ArenaConfig(side=1.0, num_pois=25, poi_radius=0.05, poi_gap=0.05857864376269048)
    classes = jnp.zeros(25, jnp.int32)
    layout = jax.jit(lambda key: sim.random_layout(key, config, classes))(jax.random.key(0))
    # There is one place for each, the middles of 5 * 5 cells.
    found = sorted(map(tuple, np.round(np.array(layout.position), 5).tolist()))
    middles = [-0.4, -0.2, 0.0, 0.2, 0.4]
    np.testing.assert_allclose(found, [(x, y) for x in middles for y in middles], atol=1e-5)


FAR = [[-0.8, 0.8], [-0.8, -0.8], [0.8, -0.8]]
BESIDE = [[0.5, 0.03], *FAR[1:]]  # PoI 0 is 0.03 m beside the way of robot 0
SLANTING = [[0.05, 0.0, 0.0], [0.2, 1.2, np.pi / 3]]  # robot 1 drives into the wall at y = 1.5
OBLIQUE = {
    "a cylinder and a wall": (BESIDE, 0.0, 0, SLANTING),
    "a turned cube and a wall": (BESIDE, np.radians(20.0), 2, SLANTING),
    "robots, 0.02 m off": (FAR, 0.0, 0, [[-0.2, 0.0, 0.0], [0.2, 0.02, np.pi]]),
    "robots, head on": (FAR, 0.0, 0, [[-0.2, 0.0, 0.5], [0.0, 0.2 * np.tan(0.5), 0.5 + np.pi]]),
}


@pytest.mark.parametrize("name", OBLIQUE)
def test_oblique_contacts_agree_with_c_mujoco(contact_arena, drive_in_contact, name):
    position, yaw, kind, poses = OBLIQUE[name]
    classes = jnp.array([kind, 0, 2])
    yaws = jnp.array([yaw, 0.0, 0.0])
    layout = sim.make_layout(ArenaConfig(), jnp.array(position), yaws, classes)
    speeds = np.full((STEPS, 2, 2), 8.0, np.float32)
    start, states = drive_in_contact(layout, jnp.array(poses), speeds)
    expected = native_trajectory(contact_arena, start, speeds)
    tolerances = {"qpos": 2e-5, "qvel": 5e-4, "xpos": 2e-5, "xmat": 2e-5}
    for (field, atol), ours, theirs in zip(tolerances.items(), states, expected, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=atol, err_msg=field)
    first, second = np.split(states[0], 2, axis=-1)
    if name.startswith("robots"):
        # Two robots of 0.0495 m; soft contacts give way by some millimetres.
        nearest = np.linalg.norm((first - second)[:, :2], axis=-1).min()
        assert 0.090 < nearest < 0.099
    else:
        # Robot 0 slides off to one side of the PoI, robot 1 along the wall.
        assert first[-1, 1] < -0.005
        assert 1.445 < second[-1, 1] < 1.4505 + 0.005
        assert second[-1, 0] > 0.35
