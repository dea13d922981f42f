import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from navigating import ARENA, PERIOD, layout_of

from jaxsense import sim
from jaxsense.mission import navigation


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


@pytest.mark.parametrize("seconds", [0.05, 0.1, 0.2])
def test_arcs_are_a_grid_of_all_speeds_and_the_turn_rates_within_reach(seconds):
    # One speed backwards and five of 0 to 0.2 m/s; 21 turn rates of -1 to 1 rad/s.
    speeds, turn_rates = [-0.1, 0, 0.05, 0.1, 0.15, 0.2], 0.1 * np.arange(-10, 11)
    for present in np.linspace(-1.05, 1.05, 43):
        samples = np.array(arcs_of(present, seconds)[0])
        # Twice 3.2 rad/s^2 for 0.05, 0.1 and 0.2 s hold 0.32, 0.64 and 1.28 rad/s.
        assert len(samples) == 6 * {0.05: 4, 0.1: 7, 0.2: 13}[seconds]
        np.testing.assert_allclose(np.unique(samples[:, 0]), speeds, atol=1e-6)
        tried = np.unique(samples[:, 1])
        assert len(np.unique(samples, axis=0)) == 6 * len(tried) == len(samples)
        in_reach = turn_rates[np.abs(turn_rates - present) <= 3.2 * seconds + 1e-6]
        assert all(np.abs(tried - turn_rate).min() < 1e-6 for turn_rate in in_reach)


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


def drive(poses, commands, waypoint):
    args = jnp.zeros(poses), jnp.zeros(commands), 0, jnp.zeros(waypoint), PERIOD, jnp.bool_(False)
    return navigation.drive_to(ARENA, layout_of(), *args)


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
    with pytest.raises(ValueError, match=name):
        jax.eval_shape(lambda: call(wrong))


@pytest.mark.parametrize("horizon", [1.0, 4.0])
def test_a_robot_may_leave_its_arc_after_half_the_horizon(horizon):
    settings = dataclasses.replace(horizon=horizon)
    waypoint = jnp.array([0.1 * horizon / 2, 0.0])  # where it is by then at 0.1 m/s
    args = layout_of(), jnp.zeros((1, 3)), jnp.array([[0.2, 0.0]]), 0, waypoint, PERIOD
    drive_to = jax.jit(functools.partial(navigation.drive_to, settings, ARENA, *args))
    np.testing.assert_allclose(drive_to(jnp.bool_(False)), [0.1, 0.0], atol=1e-6)
