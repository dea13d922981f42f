import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from jaxsense import sim
from jaxsense.config.scene import SHAPES, ArenaConfig
from jaxsense.mission import navigation
from jaxsense.sim import amiro

ARENA = ArenaConfig()


@pytest.mark.parametrize(
    ("command", "left", "right"),
    [
        ((0.2, 0.0), 7.180039, 7.180039),  # 0.2 m/s / 0.027855 m
        ((0.0, 1.0), -1.238557, 1.238557),  # 1 rad/s * 0.0345 m / 0.027855 m
        ((0.2, 1.0), 5.941483, 8.418597),  # the sum of both
        ((-0.1, -0.5), -2.970741, -4.209298),  # minus a half of it
    ],
)
def test_wheel_speeds_are_those_worked_by_hand(command, left, right):
    speeds = navigation.wheel_speeds(jnp.array(command))
    np.testing.assert_allclose(speeds, [left, right], atol=1e-5)


def test_turning_takes_of_the_motors_what_the_robots_inertia_asks_for(arena):
    mj_data, inertia = mujoco.MjData(arena.mj_model), np.zeros((6, 6))
    mujoco.mj_forward(arena.mj_model, mj_data)
    mujoco.mj_fullM(arena.mj_model, mj_data, inertia)
    # Two wheels with at most F each: forward 2 F = m a; for turning, one gives up d F of it, and
    # d F * 0.069 / 2 = I w'.
    mass, yaw_inertia = inertia[0, 0], inertia[2, 2]
    assert pytest.approx(yaw_inertia / (0.069 / 2) / mass, rel=1e-6) == amiro.FORWARD_PER_TURN


@pytest.mark.parametrize(
    ("command", "wanted", "seconds", "expected"),
    [
        ((0.0, 0.3), (0.2, 0.3), 0.01, (0.025, 0.3)),  # 2.5 m/s^2
        ((0.0, 0.3), (-0.2, 0.3), 0.01, (-0.025, 0.3)),
        ((0.1, 0.0), (0.1, 1.0), 0.01, (0.1, 0.032)),  # 3.2 rad/s^2
        ((0.1, 0.0), (0.1, -1.0), 0.01, (0.1, -0.032)),
        # For each rad/s of turning 0.035938 m/s less forward: 0.025 - 0.032 * 0.035938.
        ((0.0, 0.0), (0.2, 1.0), 0.01, (0.02385, 0.032)),
        ((0.0, 0.0), (-0.1, -1.0), 0.01, (-0.02385, -0.032)),
        # 0.2 - (0.125 - 0.16 * 0.035938), 1 - 0.16.
        ((0.2, 1.0), (-0.1, -1.0), 0.05, (0.08075, 0.84)),
        ((0.0, 0.0), (0.02, 1.0), 0.01, (0.02, 0.032)),
        ((0.1, 0.2), (0.11, 0.18), 0.01, (0.11, 0.18)),  # both are within reach
        ((0.19, -0.99), (0.5, -3.0), 0.1, (0.2, -1.0)),  # 0.2 m/s and 1 rad/s at most
        ((-0.19, 0.99), (-0.5, 3.0), 0.1, (-0.2, 1.0)),
    ],
)
def test_a_ramp_keeps_to_the_limits(command, wanted, seconds, expected):
    after = navigation.ramp(jnp.array(command), jnp.array(wanted), seconds)
    np.testing.assert_allclose(after, expected, atol=1e-6)


@pytest.mark.parametrize(
    ("bearing", "turn"), [(0.1, 0.4), (-0.1, -0.4), (0.3, 1.0), (-3.0, -1.0), (0.0, 0.0)]
)
def test_a_robot_turns_to_face_a_bearing_at_four_per_second_and_at_most_one(bearing, turn):
    np.testing.assert_allclose(navigation.face(jnp.float32(bearing)), [0.0, turn], atol=1e-6)


@pytest.fixture(scope="module")
def clearance():
    return jax.jit(lambda *given: jnp.minimum(*navigation.clearance(ARENA, *given)))


# The directions of a side and of a corner of the cube at (0, 1), which is turned by 30 degrees.
SIDE = np.array([np.cos(np.radians(30)), np.sin(np.radians(30))])
CORNER = np.array([np.cos(np.radians(75)), np.sin(np.radians(75))])


@pytest.mark.parametrize(
    ("place", "expected"),
    [
        ((1.3, 0.4), 0.1505),  # wall at 1.5: 0.2 - 0.0495
        ((-0.5, -1.4), 0.0505),  # wall at -1.5: 0.1 - 0.0495
        ((-0.3, -0.4), 0.3505),  # cylinder: 0.5 - 0.1 - 0.0495
        ((0.7, -0.95), 0.1505),  # side of the cube at (1, -1): 0.3 - 0.1 - 0.0495
        # Corner of the same: 0.16 - 0.1 and 0.18 - 0.1 beyond it, hypot(0.06, 0.08) - 0.0495.
        ((0.84, -0.82), 0.0505),
        ((0, 1) + 0.3 * SIDE, 0.1505),  # as above
        ((0, 1) - 0.3 * CORNER, 0.109079),  # 0.3 - 0.141421 - 0.0495
        ((-0.7, 0.5), 0.101),  # the other robot 0.2 away: 0.2 - 2 * 0.0495
        ((0.05, 0.0), -0.0995),  # in the cylinder: 0.05 - 0.1 - 0.0495
        ((1.0, -0.96), -0.1095),  # in the cube: 0.04 - 0.1 - 0.0495
        ((1.48, 0.4), -0.0295),  # in the wall: 0.02 - 0.0495
        ((-0.9, 0.44), -0.039),  # in the other robot: 0.06 - 2 * 0.0495
    ],
)
def test_clearance_is_that_worked_by_hand(clearance, known_layout, place, expected):
    poses = jnp.array([[*place, 0.7], [-0.9, 0.5, -2.0]], jnp.float32)
    assert clearance(known_layout, poses)[0] == pytest.approx(expected, abs=1e-5)
    # The order of the robots is of no importance, nor where they look.
    assert clearance(known_layout, poses[::-1])[1] == pytest.approx(expected, abs=1e-5)


def test_clearance_is_the_least_distance_that_c_mujoco_finds(arena, place, set_native, clearance):
    layouts = jax.jit(lambda key, classes: sim.random_layout(key, ARENA, classes))
    rng = np.random.default_rng(0)

    def near(centre, low, high):
        angle, distance = rng.uniform(-np.pi, np.pi), rng.uniform(low, high)
        return centre + distance * np.array([np.cos(angle), np.sin(angle)])

    ours, expected, nearest = [], [], []
    for seed in range(200):
        layout = layouts(jax.random.key(seed), jnp.array(rng.integers(0, 3, 3)))
        poses = rng.uniform(-1.45, 1.45, (2, 3))
        poses[0, :2] = near(layout.position[rng.integers(3)], 0.08, 0.4)
        if seed % 3 == 0:
            poses[1, :2] = near(poses[0, :2], 0.06, 0.3)
        poses = poses.astype(np.float32)
        mj_data = set_native(place(layout, jnp.array(poses)))
        shapes = [tuple(SHAPES)[int(shape)] for shape in layout.shape]
        shown = [f"poi{n}_{shape}" for n, shape in enumerate(shapes)]
        for robot in (0, 1):
            distances = [1.5 - np.abs(poses[robot, :2]).max() - 0.0495]
            collider = arena.mj_model.geom(f"robot{robot}_collider").id
            for name in (f"robot{1 - robot}_collider", *shown):
                args = collider, arena.mj_model.geom(name).id, 10.0, np.zeros(6)
                distances.append(mujoco.mj_geomDistance(arena.mj_model, mj_data, *args))
            expected.append(min(distances))
            nearest.append(["wall", "robot", *shapes][np.argmin(distances)])
        ours.extend(clearance(layout, jnp.array(poses)))
    ours, expected, nearest = np.array(ours), np.array(expected), np.array(nearest)
    # All kinds of things, free of them and in them.
    for kind in ("wall", "robot", "cylinder", "cube"):
        assert (nearest == kind).sum() > 30
    for kind in ("robot", "cylinder", "cube"):
        assert (expected[nearest == kind] < 0).sum() > 5
    # The collider is a sphere in the robot's middle at 0.052 m: more than 0.052 + 0.0495 m deep in
    # a PoI, it gets out soonest through the floor.
    is_shallow = expected > -0.1
    assert is_shallow.mean() > 0.9
    np.testing.assert_allclose(ours[is_shallow], expected[is_shallow], rtol=0, atol=1e-4)
