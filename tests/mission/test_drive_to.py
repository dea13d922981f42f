import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsense import sim
from jaxsense.config.scene import ArenaConfig
from jaxsense.mission import navigation

ARENA, PERIOD = ArenaConfig(), 0.1  # s


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
    drive_to = jax.jit(functools.partial(navigation.drive_to, ARENA), static_argnums=(3, 5))

    def command(layout, poses, commands, waypoint, backs_off=False):
        state = jnp.array(poses, jnp.float32), jnp.array(commands, jnp.float32)
        waypoint = jnp.array(waypoint, jnp.float32)
        return np.array(drive_to(layout, *state, 0, waypoint, PERIOD, jnp.bool_(backs_off)))

    return command


arcs_of = jax.jit(navigation._arcs, static_argnums=1)


@pytest.mark.parametrize("turn_rate", [-0.97, 0.0, 0.35])
def test_arcs_are_those_of_a_unicycle(turn_rate):
    commands, times, x, y, cos, sin = (np.array(of_arcs) for of_arcs in arcs_of(turn_rate, PERIOD))
    # Shares 0.1, 0.2, 0.3, 0.5, 0.75 and 1 of 2 s.
    np.testing.assert_allclose(times, [0.2, 0.4, 0.6, 1.0, 1.5, 2.0], atol=1e-6)
    expected = []
    for forward, turn in commands.astype(np.float64):
        middles = turn * (np.arange(2000) + 0.5) * 1e-3
        path = forward * 1e-3 * np.cumsum([np.cos(middles), np.sin(middles)], axis=1)
        at = np.round(times * 1000).astype(int) - 1
        expected.append([*path[:, at], np.cos(turn * times), np.sin(turn * times)])
    np.testing.assert_allclose(np.stack([x, y, cos, sin], axis=1), expected, atol=1e-6)


@pytest.mark.parametrize(
    ("least", "seconds"), [(0.1, 0.0), (0.05, 0.05), (0.02, 0.08), (0.0, 0.1), (-0.1, 0.1)]
)
def test_an_arc_that_has_come_near_something_takes_longer(least, seconds):
    arcs = arcs_of(0.0, PERIOD)
    arrival = lambda room: navigation._arrival(arcs, jnp.float32(1), jnp.float32(0), room)  # noqa: E731
    free = jnp.ones_like(arcs.x)
    found = arrival(free.at[:, 2].set(least)) - arrival(free)
    np.testing.assert_allclose(found, np.tile([0, 0] + [seconds] * 4, (len(found), 1)), atol=1e-6)


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
        return commands[1], navigation.drive_to(ARENA, *args)

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


@pytest.mark.parametrize(("ahead", "is_free"), [(0.39, False), (0.4, True)])
def test_a_robot_does_not_rely_on_another_to_drive_on(command_to, ahead, is_free):
    # At full speed it is at its waypoint in 1 s, 0.2 m on. The other drives ahead as fast, but has
    # to be 0.2 - 0.005 m away even if it stops.
    poses = [[0.0, 0.0, 0.0], [ahead, 0.0, 0.0]]
    command = command_to(layout_of(), poses, [[0.2, 0.0], [0.2, 0.0]], [0.2, 0.0])
    assert np.allclose(command, [0.2, 0.0]) == is_free


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


def move(layout, poses, commands, wanted):
    """Poses and commands after one period of driving like a unicycle, and the least clearance."""

    def step(state, _):
        poses, commands = state
        commands = navigation.ramp(commands, wanted, 0.01)
        forward, turn = commands[:, 0], commands[:, 1]
        heading = poses[:, 2] + 0.005 * turn
        velocity = jnp.stack([forward * jnp.cos(heading), forward * jnp.sin(heading), turn], -1)
        poses += 0.01 * velocity
        return (poses, commands), jnp.min(jnp.minimum(*navigation.clearance(ARENA, layout, poses)))

    (poses, commands), clearance = jax.lax.scan(step, (poses, commands), length=10)
    return poses, commands, jnp.min(clearance)


@jax.jit
@jax.vmap
def meet(yaw, beside):
    """Two robots that drive at each other in some direction, one of them beside the other's way.

    Paths as seen along it `[T, 2, 2]`, distances to the goals `[T, 2]`, and the least clearance.
    """
    turn = jnp.array([[jnp.cos(yaw), -jnp.sin(yaw)], [jnp.sin(yaw), jnp.cos(yaw)]])
    starts = jnp.array([[-0.9, 0.0], [0.9, 0.0]]) + beside * jnp.array([[0.0, 0.0], [0.0, 1.0]])
    goals = starts * jnp.array([[-1.0, 1.0]]) @ turn.T
    yaws, layout = jnp.stack([yaw, yaw + jnp.pi]), layout_of()
    drive_to = functools.partial(navigation.drive_to, ARENA, layout)

    def step(state, _):
        wanted = [
            drive_to(*state, r, goal, PERIOD, jnp.bool_(False)) for r, goal in enumerate(goals)
        ]
        poses, commands, clearance = move(layout, *state, jnp.stack(wanted))
        return (poses, commands), (poses, clearance)

    state = jnp.concatenate([starts @ turn.T, yaws[:, None]], axis=-1), jnp.zeros((2, 2))
    _, (path, clearance) = jax.lax.scan(step, state, length=150)
    away = jnp.linalg.norm(path[..., :2] - goals[None], axis=-1)
    return path[..., :2] @ turn, away, clearance.min()


def test_two_robots_that_drive_at_each_other_pass_and_do_not_touch():
    yaw = np.linspace(-3, 3, 25, dtype=np.float32)
    beside = np.tile(np.linspace(-0.2, 0.2, 5, dtype=np.float32), 5)
    path, away, clearance = jax.tree.map(np.array, meet(yaw, beside))
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


@pytest.fixture(scope="module")
def sidestep():
    step = jax.jit(functools.partial(navigation.sidestep, ARENA))

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
    # The last of several counts.
    np.testing.assert_allclose(sidestep([(0.4, 0.0), other]), expected, atol=1e-5)


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
