"""The robot of the node for ROS 2: where it looks, and what it makes of scans."""

import math
import re

import numpy as np
import pytest
from ros2_robot import CONTENTS, OWN, POSITIONS, arrive, see


@pytest.mark.parametrize("is_upside_down", [False, True])
def test_a_scan_from_left_to_right_is_turned(ros2, robot, stub, is_upside_down):
    ranges, robot.is_upside_down = np.linspace(1, 3, 9), is_upside_down
    # A scanner that hangs has its first beam on the other side.
    angles = OWN if is_upside_down else OWN[::-1]
    see(ros2, robot, arrive(robot), angles, ranges[::-1])
    np.testing.assert_allclose(stub.asked[0]["readings"], ranges, rtol=1e-5)


def test_scans_of_other_numbers_of_beams_are_resampled(ros2, robot, stub):
    # Every two degrees over a whole turn, from 0 on: 1 m and one millimetre for each degree.
    angles = np.radians(np.arange(0, 360, 2.0))
    ranges = 1 + 0.001 * np.degrees((angles + np.pi) % (2 * np.pi) - np.pi)
    see(ros2, robot, arrive(robot), angles, ranges)
    np.testing.assert_allclose(stub.asked[0]["readings"], 1 + 0.001 * np.degrees(OWN), rtol=1e-5)


@pytest.mark.parametrize(
    ("degrees", "expected"),
    [
        # The run's beams are 10 degrees apart; from left to right, as some drivers have it.
        (100 - 29.9 * np.arange(6), None),
        (100 - 30.1 * np.arange(6), "step of beams = 30.10 degrees: must be 30.00 or less"),
        (np.arange(-10, 11, 10.0), "field of view = 20.0 degrees: must be 30.0 or more"),
    ],
)
def test_a_scanner_that_sees_too_little_is_refused_before_it_drives(
    ros2, robot, stub, degrees, expected
):
    scan = ros2.Scan(9.0, np.zeros(3), np.radians(degrees), np.ones(len(degrees)))
    if expected is None:
        assert robot.see(9.0, scan) is None
    else:
        with pytest.raises(ValueError, match=expected):
            robot.see(9.0, scan)
    assert stub.asked == []


def test_the_goal_is_the_nearest_viewpoint(robot):
    # The PoI is 2 m ahead: from 0.9 m before it, facing it.
    np.testing.assert_allclose(arrive(robot), [1.1, 0, 0], atol=1e-6)
    assert robot.target == 0


@pytest.mark.parametrize("mounting", [(0, 0, 0), (0.2, 0.1, 0), (0.1, -0.2, math.pi / 2)])
def test_bearing_and_distance_are_those_of_the_sensor(ros2, robot, stub, mounting):
    robot.mounting = np.array(mounting, float)
    goal = arrive(robot)
    assert see(ros2, robot, goal) is not None
    asked = stub.asked[0]
    assert asked["distance"] == pytest.approx(0.9)
    assert asked["bearing"] == pytest.approx(0, abs=1e-6)
    # Turned by 0.2 to the left, the PoI is to the right.
    robot.goal, robot.target = goal, 0
    x, y, yaw = goal + np.array([0, 0, 0.2])
    ahead, left, turn = mounting
    away = POSITIONS[0] - [
        x + math.cos(yaw) * ahead - math.sin(yaw) * left,
        y + math.sin(yaw) * ahead + math.cos(yaw) * left,
    ]
    see(ros2, robot, (x, y, yaw))
    asked = stub.asked[1]
    assert asked["distance"] == pytest.approx(math.hypot(*away))
    told = yaw + turn + asked["bearing"]
    expected = away / math.hypot(*away)
    np.testing.assert_allclose([math.cos(told), math.sin(told)], expected, atol=1e-6)


def test_a_robot_looks_only_from_its_viewpoint_and_in_time(ros2, robot, stub):
    goal = arrive(robot)
    assert see(ros2, robot, goal - [0.4, 0, 0]) is None  # too far from the viewpoint
    assert see(ros2, robot, goal + np.array([0, 0, 0.4])) is None  # not facing the PoI
    assert see(ros2, robot, goal, age=0.31) is None  # too old
    assert see(ros2, robot, goal, age=-0.31) is None  # of another clock
    assert stub.asked == []
    assert see(ros2, robot, goal, age=0.29) is not None


@pytest.mark.parametrize(
    ("speed", "period", "looks"),
    [
        ((0.3, 0, 0), 1 / 40, False),
        ((0.3, 0, 0), 1 / 10, False),
        ((0.05, 0, 0), 1 / 40, True),
        ((0.05, 0, 0), 1, False),
        ((0, 0, 0.2), 1 / 10, False),
        ((0, 0, 0), 1, True),
        ((0, 0, 0), 0, False),  # the same scan twice
    ],
)
def test_whether_a_robot_stands_still_does_not_depend_on_the_rate_of_scans(
    ros2, robot, speed, period, looks
):
    goal = arrive(robot)
    away = goal - period * np.array(speed)
    assert robot.see(9.0, ros2.Scan(9.0, away, OWN, np.ones(9))) is None
    scan = ros2.Scan(9.0 + period, goal, OWN, np.ones(9))
    assert (robot.see(9.0 + period, scan) is not None) == looks


def test_a_look_updates_the_map_and_the_next_choice_is_new(ros2, robot):
    goal = arrive(robot)
    look = see(ros2, robot, goal)
    assert look == {"poi": 0, "features": [0.75, 0.25], "weight": 1.0, "place": [*goal[:2]]}
    np.testing.assert_allclose(robot.known["mean"][:, 0], [0.75, 0, 0])
    np.testing.assert_array_equal(robot.known["seen"], [[0, 1], [0, 0], [0, 0]])
    assert robot.goal is None
    # Again at the same PoI: from where a look is new, 0.5 m away and more.
    again = arrive(robot, goal)
    assert robot.target == 0
    assert 0.5 <= np.linalg.norm(again[:2] - goal[:2]) < 0.9


@pytest.mark.parametrize("is_known", [True, False])
def test_after_failures_elsewhere_a_poi_is_given_up(ros2, robot, stub, is_known):
    stub.detects, stub.is_known, said = False, is_known, []
    robot.say = said.append
    goals = [arrive(robot)]
    for _ in range(2):
        assert see(ros2, robot, goals[-1]) is None
        goals.append(arrive(robot, goals[-1]))
        assert robot.target == 0
    apart = [np.linalg.norm(a[:2] - b[:2]) for a in goals for b in goals if a is not b]
    assert min(apart) >= 0.3
    see(ros2, robot, goals[-1])
    arrive(robot, goals[-1])
    assert (robot.target, robot.team["present"].tolist()) == (1, [False, True, True])
    assert robot.known["seen"].sum() == 0
    why = "nothing detected of" if is_known else "outside of what was learned:"
    assert said[:2] == [f"{why} PoI 0, 0.90 m away", "failure 1 of 3 at PoI 0"]


@pytest.mark.parametrize(
    ("robot", "positions", "expected"),
    [
        (-1, POSITIONS, "robot = -1: must be one of {0: 'camera', 1: 'lidar'}"),
        (2, POSITIONS, "robot = 2: must be one of"),
        (1, POSITIONS[:2], "2 PoIs: the policy of this archive is for 3"),
        (1, [[0, 1], [1, 2], [math.nan, 0]], "must be finite numbers of shape (3, 2)"),
        (1, [[0, 1, 2], [1, 2, 2], [1, 0, 2]], "must be finite numbers of shape (3, 2)"),
        (1, [[0, 1], [1, 2], [0, 1]], "must differ from each other"),
    ],
)
def test_a_robot_that_does_not_fit_is_named(ros2, stub, robot, positions, expected):
    with pytest.raises(ValueError, match=re.escape(expected)):
        ros2.Robot(CONTENTS, stub.programs(), robot, positions)
    with pytest.raises(ValueError, match="maps of their own"):
        ros2.Robot(CONTENTS, {**stub.programs(), "merge": None}, 1, POSITIONS)
