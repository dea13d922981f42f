import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from jaxsense import sim
from jaxsense.config import SHAPES, ArenaConfig, Config, NavigationConfig
from jaxsense.sim import amiro, navigation, roadmap

CONFIG = Config()
ARENA, SETTINGS = ArenaConfig(), NavigationConfig()
# A cube of half side 0.1 reaches 0.141421 from its centre, a robot is planned with 0.1.
KEEP = 0.241421  # m
PERIOD = 0.1  # s


def layout_of(*positions):
    """A layout with cylinders at some places and the others, of three, far outside."""
    outside = [[9.0, 9.0], [-9.0, 9.0], [9.0, -9.0]]
    position = jnp.array([*positions, *outside[len(positions) :]], jnp.float32)
    return sim.make_layout(ARENA, position, jnp.zeros(3), jnp.zeros(3, jnp.int32))


def turned(angle, x, y):
    return jnp.array([np.cos(angle) * x - np.sin(angle) * y, np.sin(angle) * x + np.cos(angle) * y])


@pytest.fixture(scope="module")
def command_to():
    """The command that `drive_to` gives robot 0, with one or two robots."""
    drive_to = jax.jit(
        functools.partial(navigation.drive_to, SETTINGS, ARENA), static_argnums=(3, 5)
    )

    def command(layout, poses, commands, waypoint, backs_off=False):
        state = jnp.array(poses, jnp.float32), jnp.array(commands, jnp.float32)
        waypoint = jnp.array(waypoint, jnp.float32)
        return np.array(drive_to(layout, *state, 0, waypoint, PERIOD, jnp.bool_(backs_off)))

    return command


def move(layout, poses, commands, wanted):
    """Poses and commands after one period of driving like a unicycle, and the least clearance."""

    def step(state, _):
        poses, commands = state
        commands = navigation.ramp(commands, wanted, 0.01)
        forward, turn = commands[:, 0], commands[:, 1]
        heading = poses[:, 2] + 0.005 * turn
        velocity = jnp.stack([forward * jnp.cos(heading), forward * jnp.sin(heading), turn], -1)
        poses += 0.01 * velocity
        return (poses, commands), jnp.min(navigation.clearance(ARENA, layout, poses))

    (poses, commands), clearance = jax.lax.scan(step, (poses, commands), length=10)
    return poses, commands, jnp.min(clearance)


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


def test_wheel_speeds_drive_the_robot_as_commanded():
    commands = jax.random.uniform(jax.random.key(0), (5, 3, 2), minval=-1.0)
    left, right = np.moveaxis(np.array(navigation.wheel_speeds(commands)), -1, 0) * 0.05571 / 2
    np.testing.assert_allclose((left + right) / 2, commands[..., 0], atol=1e-5)
    np.testing.assert_allclose((right - left) / 0.069, commands[..., 1], atol=1e-5)


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
    ("command", "wanted", "steps"),
    [
        ((0.0, 0.0), (0.2, 0.0), (8, 1)),  # 0.2 / 0.025 = 8
        ((0.0, 0.0), (0.2, 1.0), (9, 32)),  # 0.2 / 0.02385 = 8.4, 1 / 0.032 = 31.25
        ((0.2, -0.5), (-0.1, 0.2), (13, 22)),  # 0.3 / 0.02385 = 12.6, 0.7 / 0.032 = 21.9
    ],
)
def test_a_ramp_reaches_the_wanted_command_in_time_and_stays(command, wanted, steps):
    def step(command, _):
        command = navigation.ramp(command, jnp.array(wanted), 0.01)
        return command, command

    _, commands = jax.lax.scan(step, jnp.array(command), length=40)
    is_there = np.abs(np.array(commands) - wanted) < 1e-6
    np.testing.assert_array_equal(np.argmax(is_there, axis=0) + 1, steps)
    np.testing.assert_array_equal(is_there.sum(axis=0), 41 - np.array(steps))


def test_a_ramp_takes_the_commands_of_all_robots_at_once():
    commands, wanted = jnp.array([[0.0, 0.0], [0.2, 1.0]]), jnp.array([[0.2, 1.0], [-0.1, 1.0]])
    after = navigation.ramp(commands, wanted, 0.01)
    # As above: only the first one turns.
    np.testing.assert_allclose(after, [[0.02385, 0.032], [0.175, 1.0]], atol=1e-6)


@pytest.mark.parametrize(
    ("bearing", "turn"), [(0.1, 0.4), (-0.1, -0.4), (0.3, 1.0), (-3.0, -1.0), (0.0, 0.0)]
)
def test_a_robot_turns_to_face_a_bearing_at_four_per_second_and_at_most_one(bearing, turn):
    np.testing.assert_allclose(navigation.face(jnp.float32(bearing)), [0.0, turn], atol=1e-6)


@pytest.fixture(scope="module")
def clearance():
    return jax.jit(functools.partial(navigation.clearance, ARENA))


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
        shapes = [SHAPES[int(shape)] for shape in layout.shape]
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


def test_arcs_are_those_of_a_unicycle():
    samples, times, x, y, heading = navigation._arcs(SETTINGS)
    # Shares 0.1, 0.2, 0.3, 0.5, 0.75 and 1 of 2 s.
    np.testing.assert_allclose(times, [0.2, 0.4, 0.6, 1.0, 1.5, 2.0], atol=1e-6)
    expected = []
    for forward, turn in samples.astype(np.float64):
        middles = turn * (np.arange(2000) + 0.5) * 1e-3
        path = forward * 1e-3 * np.cumsum([np.cos(middles), np.sin(middles)], axis=1)
        at = np.round(times * 1000).astype(int) - 1
        expected.append([*path[:, at], turn * times])
    np.testing.assert_allclose(np.stack([x, y, heading], axis=1), expected, atol=1e-6)


def test_arcs_are_a_grid_of_all_speeds_and_turn_rates():
    samples = navigation._arcs(SETTINGS)[0]
    assert samples.shape == (6 * 21, 2)
    # One speed backwards and five of 0 to 0.2 m/s; 21 turn rates of -1 to 1 rad/s.
    np.testing.assert_allclose(np.unique(samples[:, 0]), [-0.1, 0, 0.05, 0.1, 0.15, 0.2], atol=1e-6)
    np.testing.assert_allclose(samples[:21, 1], 0.1 * np.arange(-10, 11), atol=1e-6)
    assert len(np.unique(samples, axis=0)) == 126


@pytest.mark.parametrize("yaw", [0.0, 1.0, -2.5])
@pytest.mark.parametrize(
    ("goal", "expected"),
    [
        ((1.0, 0.0), (0.2, 0.0)),  # ahead, at full speed
        ((0.0, 1.0), (0.0, 0.3)),  # 0.1 s * 3.2 rad/s^2 allow 0.3 of the tried rad/s, left
        ((0.0, -1.0), (0.0, -0.3)),  # and right
        ((-1.0, 0.3), (-0.1, 0.3)),  # behind: backwards while it turns
        ((-1.0, -0.3), (-0.1, -0.3)),
        ((-0.15, 0.0), (-0.1, 0.0)),  # so near that turning takes longer than to back up
    ],
)
def test_a_robot_at_rest_sets_out_for_its_waypoint(command_to, yaw, goal, expected):
    poses = [[*turned(yaw, -0.2, 0.1), yaw]]
    waypoint = turned(yaw, goal[0] - 0.2, goal[1] + 0.1)
    command = command_to(layout_of(), poses, [[0.0, 0.0]], waypoint)
    np.testing.assert_allclose(command, expected, atol=1e-6)


def test_a_robot_at_full_speed_goes_on_straight_ahead(command_to):
    command = command_to(layout_of(), [[-1.0, 0.5, 0.0]], [[0.2, 0.0]], [1.0, 0.5])
    np.testing.assert_allclose(command, [0.2, 0.0], atol=1e-6)


@pytest.mark.parametrize("seconds", [0.1, 0.04])
def test_commands_stay_within_the_accelerations_of_the_robot(seconds):
    def draw(key):
        keys = jax.random.split(key, 4)
        layout = sim.random_layout(keys[0], ARENA, jnp.array([0, 1, 2]))
        poses = jax.random.uniform(keys[1], (2, 3), minval=-1.4, maxval=1.4)
        low, high = jnp.array([[-0.1, -1.0]]), jnp.array([[0.2, 1.0]])
        commands = jax.random.uniform(keys[2], (2, 2), minval=low, maxval=high)
        waypoint = jax.random.uniform(keys[3], (2,), minval=-1.4, maxval=1.4)
        args = layout, poses, commands, 1, waypoint, seconds, jnp.bool_(False)
        return commands[1], navigation.drive_to(SETTINGS, ARENA, *args)

    present, wanted = jax.jit(jax.vmap(draw))(jax.random.split(jax.random.key(0), 500))
    moves = np.any(np.array(wanted) != 0, axis=-1)
    assert moves.mean() > 0.7
    change = np.abs(wanted - present)[moves].max(axis=0)
    most = np.array([2.5, 3.2]) * seconds
    assert np.all(change <= most + 1e-5)
    assert np.all(change > 0.7 * most)  # and that is made use of


@pytest.mark.parametrize("backs_off", [False, True])
@pytest.mark.parametrize(
    ("speed", "is_safe"),
    [
        (0.2, False),  # it comes nearer on every arc: even backwards, at 0.1 m/s only
        (-0.2, True),
        (0.0, True),
    ],
)
def test_a_robot_for_which_no_arc_is_safe_stops(command_to, speed, is_safe, backs_off):
    # Another robot 0.21 m ahead faces it. Turning, it could not choose to stand still: in 0.1 s
    # only turn rates of 0.18 to 0.82 rad/s can be taken up.
    poses = [[0.0, 0.0, 0.0], [0.21, 0.0, np.pi]]
    commands = [[0.1, 0.5], [speed, 0.0]]
    command = command_to(layout_of(), poses, commands, [-1.0, 0.0], backs_off)
    if is_safe:
        assert command[0] <= 0
        assert 0.18 <= command[1] <= 0.82
    else:
        np.testing.assert_array_equal(command, 0)


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize(("beside", "is_free"), [(0.2114, False), (0.245, True)])
def test_a_robot_does_not_cut_through_the_edge_of_what_it_must_keep_off(
    command_to, side, beside, is_free
):
    # Straight ahead, it would be nearer than 0.2414 to the PoI from 0.22 - 0.1166 on, and out again
    # at 0.22 + 0.1166 m, before the end of the arc at 0.4 m: 0.1166^2 + 0.2114^2 = 0.2414^2.
    layout = layout_of((0.22, side * beside))
    command = command_to(layout, [[0.0, 0.0, 0.0]], [[0.2, 0.0]], [1.0, 0.0])
    if is_free:
        np.testing.assert_allclose(command, [0.2, 0.0], atol=1e-6)
    else:
        assert side * command[1] < 0


@pytest.mark.parametrize(("ahead", "is_free"), [(0.39, False), (0.4, True)])
def test_a_robot_does_not_rely_on_another_to_drive_on(command_to, ahead, is_free):
    # At full speed it is at its waypoint in 1 s, 0.2 m on. The other drives ahead as fast, but has
    # to be 0.2 - 0.005 m away even if it stops.
    poses = [[0.0, 0.0, 0.0], [ahead, 0.0, 0.0]]
    command = command_to(layout_of(), poses, [[0.2, 0.0], [0.2, 0.0]], [0.2, 0.0])
    assert np.allclose(command, [0.2, 0.0]) == is_free


@pytest.mark.parametrize("side", [1, -1])
def test_a_robot_that_turns_goes_on_that_way_round_if_it_is_shorter(command_to, side):
    # The waypoint is 166 degrees to the one side. Turning to the other at 0.9 rad/s, there remain
    # 194 degrees; to stop first and turn back takes longer.
    waypoint = [-1.0, 0.25 * side]
    command = command_to(layout_of(), [[0.0, 0.0, 0.0]], [[0.0, -0.9 * side]], waypoint)
    assert command[1] == pytest.approx(-1.0 * side, abs=1e-6)


@pytest.mark.parametrize(
    ("distance", "forward"),
    [
        # In the 1 s of its shortest arc, it gets 0.02 m beyond at full speed: so near, it matters
        # little that it would have to turn round, and 1 s + 0.02 / 0.2 s is less than at 0.15 m/s,
        # 1 s + 0.03 / 0.2 s.
        (0.18, 0.2),
        (0.1, 0.1),  # there in 1 s; twice as fast, it would have to come back
    ],
)
def test_a_robot_does_not_slow_down_for_a_waypoint_that_it_hardly_passes(
    command_to, distance, forward
):
    command = command_to(layout_of(), [[0.0, 0.0, 0.0]], [[0.2, 0.0]], [distance, 0.0])
    np.testing.assert_allclose(command, [forward, 0.0], atol=1e-6)


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize("bias", [0.003, -0.003])
def test_of_two_ways_the_one_farther_from_a_poi_is_taken(command_to, side, bias):
    # The waypoint is behind, hardly to either side. A robot that turns left backs up to the right.
    command = [
        command_to(layout, [[0.0, 0.0, 0.0]], [[0.0, 0.0]], [-1.0, bias])
        for layout in (layout_of((-0.2, 0.3 * side)), layout_of())
    ]
    expected = [[-0.1, 0.3 * side], [-0.1, 0.3 * np.sign(bias)]]
    np.testing.assert_allclose(command, expected, atol=1e-6)


@pytest.mark.parametrize("side", [1, -1])
def test_a_way_costs_what_its_place_nearest_to_a_poi_does(command_to, side):
    # 0.02 m from where it must not be, which costs 0.08 s, a robot turns to a waypoint 1 m away at
    # 85 degrees. To back up meanwhile to (-0.0985, -0.0148), 0.12 m away from there, would make the
    # way hypot(0.1857, 1.0110) - 1 = 0.0279 m or 0.140 s longer, and turning by 5.4 degrees or
    # 0.094 s shorter. That is not worth the 0.02 s which are saved after the first 0.02 m, when the
    # cost is 0.06 s; it would be worth the 0.08 s of the end.
    waypoint = [np.cos(np.radians(85)), side * np.sin(np.radians(85))]
    command = command_to(layout_of((0.2614, 0.0)), [[0.0, 0.0, 0.0]], [[0.0, 0.0]], waypoint)
    np.testing.assert_allclose(command, [0.0, 0.3 * side], atol=1e-6)


@pytest.mark.parametrize("yaw", [0.0, 2.0])
@pytest.mark.parametrize(("course", "waits"), [(np.pi / 2, True), (-np.pi / 2, False)])
def test_a_robot_lets_one_pass_that_drives_across_its_way(command_to, yaw, course, waits):
    # After 1 s, it would be at (0.2, 0), and the other at (0.3, -0.1), 0.14 away, or (0.3, -0.5).
    poses = [[0.0, 0.0, yaw], [*turned(yaw, 0.3, -0.3), yaw + course]]
    commands = [[0.2, 0.0], [0.2, 0.0]]
    command = command_to(layout_of(), poses, commands, turned(yaw, 1.0, 0.0))
    assert np.allclose(command, [0.2, 0.0]) != waits


@pytest.mark.parametrize(
    ("place", "course", "in_the_way", "others"),
    [
        ((0.18, 0.0), 0.0, [(0.0, 0.0)], []),  # 0.0614 too near to the middle of a PoI
        ((1.45, 0.0), np.pi, [], []),  # 0.05 too near to a wall
        ((0.0, -1.45), np.pi / 2, [], []),
        ((0.14, 0.0), 0.0, [], [[0.0, 0.0, 1.0]]),  # 0.06 too near to a robot
    ],
)
def test_a_robot_too_close_to_something_may_leave_it(command_to, place, course, in_the_way, others):
    layout, commands = layout_of(*in_the_way), np.zeros((1 + len(others), 2))
    away = np.array(turned(course, 1.0, 0.0))
    command = command_to(layout, [[*place, course], *others], commands, place + away)
    np.testing.assert_allclose(command, [0.2, 0.0], atol=1e-6)
    # But not go on towards it.
    command = command_to(layout, [[*place, course + np.pi], *others], commands, place - away)
    assert command[0] <= 0


@pytest.mark.parametrize(
    ("poses", "in_the_way", "forward"),
    [
        ([[0.26, 0.0, np.pi]], [(0.0, 0.0)], -0.1),
        ([[0.26, 0.0, 0.0]], [(0.0, 0.0)], 0.2),
        ([[1.38, 0.0, 0.0]], [], -0.1),
        ([[0.0, 0.0, 0.0], [0.24, 0.0, 0.0]], [], -0.1),
    ],
    ids=["from a PoI ahead", "from a PoI behind", "from a wall", "from a robot"],
)
def test_a_robot_that_backs_off_gains_room(command_to, poses, in_the_way, forward):
    commands = np.zeros((len(poses), 2))
    command = command_to(layout_of(*in_the_way), poses, commands, [0.0, 1.0], backs_off=True)
    assert command[0] == pytest.approx(forward, abs=1e-6)


@pytest.fixture(scope="module")
def driven():
    """Ways of lone robots from random places to random places: straight on, or by the roadmap."""

    def drive(key, by_map):
        layout_key, class_key, *place_keys, yaw_key, poi_key = jax.random.split(key, 6)
        classes = jax.random.randint(class_key, (3,), 0, 3)
        layout = sim.random_layout(layout_key, ARENA, classes)

        def free_place(key):
            places = jax.random.uniform(key, (64, 2), minval=-1.4, maxval=1.4)
            apart = jnp.linalg.norm(places[:, None] - layout.position[None], axis=-1)
            return places[jnp.argmax(apart.min(axis=-1) >= KEEP)]

        start, goal = (free_place(k) for k in place_keys)
        yaw = jax.random.uniform(yaw_key, (), minval=-np.pi, maxval=np.pi)
        if by_map:
            ways = roadmap.build(CONFIG, layout)
            poi = jax.random.randint(poi_key, (), 0, 3)
            length = roadmap.lengths(CONFIG, layout, ways, start, poi)
            # Of the viewpoints with a way to them, the farthest.
            view = jnp.argmax(jnp.where(jnp.isfinite(length), length, -1.0))
            goal, distance = ways.viewpoints[poi, view], length[view]
        else:
            distance = jnp.linalg.norm(goal - start)

        def step(state, _):
            poses, commands = state
            waypoint = goal
            if by_map:
                far = jnp.full((1, 2), 1e3)
                args = poses[0, :2], far, poi, view
                _, waypoint = roadmap.next_place(CONFIG, layout, ways, *args)
            args = poses, commands, 0, waypoint, PERIOD, jnp.bool_(False)
            wanted = navigation.drive_to(SETTINGS, ARENA, layout, *args)
            poses, commands, clearance = move(layout, poses, commands, wanted[None])
            return (poses, commands), (poses[0, :2], clearance)

        state = jnp.append(start, yaw)[None], jnp.zeros((1, 2))
        _, (path, clearance) = jax.lax.scan(step, state, length=300)
        arrived = jnp.linalg.norm(path - goal[None], axis=-1) < 0.2
        seconds = jnp.where(arrived.any(), PERIOD * (1 + jnp.argmax(arrived)), jnp.inf)
        return layout.position, start, goal, distance, seconds, clearance.min()

    def run(by_map, number):
        keys = jax.random.split(jax.random.key(0), number)
        ways = jax.jit(jax.vmap(functools.partial(drive, by_map=by_map)))(keys)
        return jax.tree.map(np.array, ways)

    return run


def test_a_robot_drives_to_places_in_sight_and_touches_nothing(driven):
    position, start, goal, distance, seconds, clearance = driven(by_map=False, number=300)
    # With 0.1 m it is planned 0.0505 m larger than it is, of which a trajectory may cut 0.005.
    assert clearance.min() > 0.03
    along = (goal - start) / distance[:, None]
    share = np.sum((position - start[:, None]) * along[:, None], axis=-1)
    nearest = start[:, None] + np.clip(share, 0, distance[:, None])[..., None] * along[:, None]
    in_sight = np.linalg.norm(position - nearest, axis=-1).min(axis=-1) >= KEEP
    assert in_sight.sum() > 200
    # Where it has to turn first it may get behind a PoI, which the roadmap leads it out of.
    assert np.isfinite(seconds[in_sight]).mean() >= 0.93
    # At 0.2 m/s to 0.2 m before the goal, after at most pi s of turning: pi - 1 s longer.
    assert (seconds <= distance / 0.2 + 2.1)[in_sight].mean() > 0.9
    # No faster than its highest speed.
    assert (seconds >= (distance - 0.2) / 0.2 - 0.1).all()


def test_a_robot_that_follows_the_roadmap_always_arrives_and_touches_nothing(driven):
    _, _, _, length, seconds, clearance = driven(by_map=True, number=100)
    assert np.isfinite(length).all()
    assert length.mean() > 1.5
    assert clearance.min() > 0.03
    assert np.isfinite(seconds).all()
    assert np.max(seconds - length / 0.2) < 3


@pytest.fixture(scope="module")
def met():
    """Two robots that drive at each other, or one at another that stands, in B directions.

    How far robot 1 is beside the way of robot 0, paths as seen along it `[B, T, 2, 2]`, distances
    to the goals `[B, T, 2]`, and the least clearance.
    """

    def meet(yaw, beside, stands):
        turn = jnp.array([[jnp.cos(yaw), -jnp.sin(yaw)], [jnp.sin(yaw), jnp.cos(yaw)]])
        starts = jnp.array([[-0.9, 0.0], [0.9, 0.0]]) + beside * jnp.array([[0.0, 0.0], [0.0, 1.0]])
        goals = starts * jnp.array([[-1.0, 1.0]])
        starts = jnp.where(stands, starts * jnp.array([[1.0, 1.0], [0.0, 1.0]]), starts)
        yaws = jnp.stack([yaw, yaw + jnp.pi])
        goals = goals @ turn.T

        def step(state, _):
            poses, commands = state
            wanted = [
                navigation.drive_to(
                    SETTINGS, ARENA, layout_of(), poses, commands, r, goal, PERIOD, jnp.bool_(False)
                )
                for r, goal in enumerate(goals)
            ]
            wanted[1] = jnp.where(stands, 0.0, wanted[1])
            poses, commands, clearance = move(layout_of(), poses, commands, jnp.stack(wanted))
            return (poses, commands), (poses, clearance)

        state = jnp.concatenate([starts @ turn.T, yaws[:, None]], axis=-1), jnp.zeros((2, 2))
        _, (path, clearance) = jax.lax.scan(step, state, length=150)
        away = jnp.linalg.norm(path[..., :2] - goals[None], axis=-1)
        return path[..., :2] @ turn, away, clearance.min()

    meet = jax.jit(jax.vmap(meet))

    def run(stands):
        yaw = np.linspace(-3, 3, 25, dtype=np.float32)
        beside = np.tile(np.linspace(-0.2, 0.2, 5, dtype=np.float32), 5)
        return beside, *jax.tree.map(np.array, meet(yaw, beside, np.full(25, stands)))

    return run


def test_two_robots_that_drive_at_each_other_pass_and_do_not_touch(met):
    beside, path, away, clearance = met(stands=False)
    # Planning keeps their middles 2 * 0.1 - 0.005 apart, of which 2 * 0.0495 are the robots.
    assert clearance.min() > 0.09
    # 1.6 m to within 0.2 m at 0.2 m/s take 8 s.
    seconds = PERIOD * (1 + np.argmax(away < 0.2, axis=1))
    assert (away.min(axis=1) < 0.2).all()
    assert np.all((seconds >= 7.9) & (seconds < 11))
    # Head-on, each goes to its right.
    head_on = path[np.abs(beside) < 1e-6]
    assert np.all(head_on[:, :, 0, 1].min(axis=1) < -0.05)
    assert np.all(head_on[:, :, 1, 1].max(axis=1) > 0.05)


def test_a_robot_drives_around_one_that_stands_in_its_way(met):
    _, path, away, clearance = met(stands=True)
    assert clearance.min() > 0.09
    assert np.ptp(path[:, :, 1], axis=1).max() < 1e-6
    assert (away[:, :, 0].min(axis=1) < 0.2).all()
    assert np.argmax(away[:, :, 0] < 0.2, axis=1).max() * PERIOD < 11


@pytest.fixture(scope="module")
def sidestep():
    step = jax.jit(functools.partial(navigation.sidestep, SETTINGS, ARENA))

    def from_origin(others, layout=None, place=(0.0, 0.0)):
        """The next place on the way to 1 m further east, seen from where the robot is."""
        place, others = jnp.array(place), jnp.array(others).reshape(-1, 2) + jnp.array([place])
        layout = layout_of() if layout is None else layout
        return np.array(step(layout, place, place + jnp.array([1.0, 0.0]), others) - place)

    return from_origin


@pytest.mark.parametrize(
    "others",
    [
        [],
        [(0.5, 0.235)],  # 0.2 + 0.03 beside the way are enough
        [(0.5, -0.235)],
        [(-0.1, 0.0)],  # behind
        [(1.05, 0.0)],  # beyond the waypoint
        [(1e3, 1e3)],
    ],
)
def test_with_nobody_in_the_way_the_waypoint_stays(sidestep, others):
    np.testing.assert_array_equal(sidestep(others), [1.0, 0.0])


# From 0.52 m away, tangents to a circle of 2 * 0.1 + 0.06 = 0.26 m leave at 30 degrees to either
# side and touch it after sqrt(0.52^2 - 0.26^2) = 0.450333 m, at (0.39, +-0.225167).
RIGHT, LEFT = (0.39, -0.225167), (0.39, 0.225167)


def at(distance, degrees):
    return distance * np.array([np.cos(np.radians(degrees)), np.sin(np.radians(degrees))])


@pytest.mark.parametrize(
    ("other", "expected"),
    [
        ((0.52, 0.0), RIGHT),
        (at(0.52, 10), at(0.450333, -20)),  # to the left of the way: the right side is shorter
        (at(0.52, 1), at(0.450333, -29)),
        (at(0.52, -1), at(0.450333, -31)),  # left is shorter, but by less than 0.05 m
        (at(0.52, -10), at(0.450333, 20)),
        # Closer than 0.26, outwards: 0.15 m at 90 degrees + 1 - 0.2 / 0.26 = 0.230769 rad.
        ((0.2, 0.0), (-0.034309, -0.146024)),
        (at(0.52, 25), at(0.450333, -5)),  # 0.22 beside the way: just in it
    ],
)
def test_a_robot_in_the_way_is_passed_on_the_shorter_side(sidestep, other, expected):
    np.testing.assert_allclose(sidestep([other]), expected, atol=1e-5)


@pytest.mark.parametrize(
    ("place", "in_the_way", "expected"),
    [
        ((0.0, 0.0), [(0.39, -0.46)], LEFT),  # 0.2348 from the place on the right, less than 0.2414
        ((0.0, 0.0), [(0.39, -0.47)], RIGHT),  # 0.2448
        ((0.0, 0.0), [(0.39, 0.46)], RIGHT),
        ((0.0, 0.0), [(0.39, -0.46), (0.39, 0.46)], (1.0, 0.0)),
        ((0.0, -1.18), [], LEFT),  # on the right, 1.5 - 1.18 - 0.2252 = 0.0948 to the wall
        ((0.0, -1.17), [], RIGHT),  # 0.1048
        ((0.0, 1.3), [], RIGHT),
    ],
)
def test_a_robot_in_the_way_is_passed_where_there_is_room(sidestep, place, in_the_way, expected):
    step = sidestep([(0.52, 0.0)], layout_of(*in_the_way), place)
    np.testing.assert_allclose(step, expected, atol=1e-5)


def drive(poses, commands, waypoint):
    args = jnp.zeros(poses), jnp.zeros(commands), 0, jnp.zeros(waypoint), PERIOD, jnp.bool_(False)
    return navigation.drive_to(SETTINGS, ARENA, layout_of(), *args)


@pytest.mark.parametrize(
    ("name", "call", "right", "wrong"),
    [
        ("waypoint", lambda shape: drive((2, 3), (2, 2), shape), (2,), (3,)),
        ("commands", lambda shape: drive((2, 3), shape, (2,)), (2, 2), (3, 2)),
        (
            "poses",
            lambda shape: navigation.clearance(ARENA, layout_of(), jnp.zeros(shape)),
            (2, 3),
            (2, 4),
        ),
    ],
)
def test_wrong_shapes_are_named_while_tracing(name, call, right, wrong):
    jax.eval_shape(lambda: call(right))
    with pytest.raises(AssertionError, match=name):
        jax.eval_shape(lambda: call(wrong))
