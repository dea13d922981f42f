"""The robot of the node for ROS 2, without ROS."""

import math
import re

import numpy as np
import pytest
from ros2_messages import LaserScan
from ros2_robot import CONTENTS, OWN, POSITIONS, arrive, see


def test_a_scan_from_left_to_right_is_turned(ros2, robot, stub):
    ranges = np.linspace(1, 3, 9)
    goal = arrive(robot)
    see(ros2, robot, goal, *ros2.beams(LaserScan(OWN[-1], -OWN[1] + OWN[0], ranges[::-1])))
    np.testing.assert_allclose(stub.asked[0]["readings"], ranges, rtol=1e-5)


def test_a_scanner_may_hang_upside_down(ros2, robot, stub):
    ranges = np.linspace(1, 3, 9)
    robot.is_upside_down = True
    see(ros2, robot, arrive(robot), *ros2.beams(LaserScan(OWN[0], OWN[1] - OWN[0], ranges[::-1])))
    np.testing.assert_allclose(stub.asked[0]["readings"], ranges, rtol=1e-5)


def test_scans_of_other_numbers_of_beams_are_resampled(ros2, robot, stub):
    # Every two degrees over a whole turn, from 0 on: 1 m and one millimetre for each degree.
    angles = np.radians(np.arange(0, 360, 2.0))
    ranges = 1 + 0.001 * np.degrees((angles + np.pi) % (2 * np.pi) - np.pi)
    see(ros2, robot, arrive(robot), *ros2.beams(LaserScan(0.0, angles[1], ranges)))
    np.testing.assert_allclose(stub.asked[0]["readings"], 1 + 0.001 * np.degrees(OWN), rtol=1e-5)


def test_single_lost_beams_take_the_distance_of_their_neighbours(ros2, robot, stub):
    ranges = np.linspace(1, 3, 9)
    lost = np.where(np.arange(9) == 4, np.inf, ranges)
    see(ros2, robot, arrive(robot), *ros2.beams(LaserScan(OWN[0], OWN[1] - OWN[0], lost)))
    np.testing.assert_allclose(stub.asked[0]["readings"][[3, 4, 5]], ranges[[3, 3, 5]], rtol=1e-5)


def test_a_scanner_that_is_too_coarse_is_refused_before_the_robot_drives(ros2, robot, stub):
    # The run's beams are 10 degrees apart; from left to right, as some drivers have it.
    for step, is_dense in ((29.9, True), (30.1, False)):
        angles = np.radians(100 - step * np.arange(6))
        scan = ros2.Scan(9.0, np.zeros(3), angles, np.ones(6))
        if is_dense:
            assert robot.see(9.0, scan) is None
        else:
            expected = "step between beams = 30.10 degrees: must be at most 30.00"
            with pytest.raises(ValueError, match=expected):
                robot.see(9.0, scan)
    assert stub.asked == []


def test_beams_that_were_not_recorded_are_not_numbers(ros2, robot, stub):
    see(ros2, robot, arrive(robot), OWN[:5], np.ones(5))
    np.testing.assert_array_equal(stub.asked[0]["readings"], [1] * 5 + [np.nan] * 4)


def test_the_goal_is_the_nearest_viewpoint(robot):
    # The PoI is 2 m ahead: from 0.9 m before it, facing it.
    np.testing.assert_allclose(arrive(robot), [1.1, 0, 0], atol=1e-9)
    assert robot.target == 0


def test_the_goal_is_not_where_another_robot_is(ros2, robot, stub):
    other = ros2.Robot(CONTENTS, stub.programs(), 0, POSITIONS)
    arrive(other, (1.1, 0.1, 0.0))
    robot.hear(0.0, other.report())
    goal = arrive(robot)
    assert np.linalg.norm(goal[:2] - [1.1, 0.1]) >= 0.3
    assert np.linalg.norm(goal[:2] - POSITIONS[0]) == pytest.approx(0.9)


@pytest.mark.parametrize("mounting", [(0, 0, 0), (0.2, 0.1, 0), (0.1, -0.2, math.pi / 2)])
def test_bearing_and_distance_are_those_of_the_sensor(ros2, robot, stub, mounting):
    robot.mounting = np.array(mounting, float)
    goal = arrive(robot)
    assert see(ros2, robot, goal) is not None
    asked = stub.asked[0]
    assert asked["distance"] == pytest.approx(0.9)
    assert asked["bearing"] == pytest.approx(0, abs=1e-6)
    # Turned by 0.2 to the left, the PoI is to the right.
    arrive(robot, goal)
    robot.goal, robot.target = goal, 0
    turned = goal + np.array([0, 0, 0.2])
    sensor = ros2.compose(turned, robot.mounting)
    away = POSITIONS[0] - sensor[:2]
    see(ros2, robot, turned)
    asked = stub.asked[1]
    assert asked["distance"] == pytest.approx(math.hypot(*away))
    told = sensor[2] + asked["bearing"]
    expected = away / math.hypot(*away)
    np.testing.assert_allclose([math.cos(told), math.sin(told)], expected, atol=1e-6)


def test_a_robot_looks_only_from_its_viewpoint_when_it_stands_still(ros2, robot, stub):
    goal = arrive(robot)
    assert see(ros2, robot, goal - [0.4, 0, 0]) is None  # too far from the viewpoint
    assert see(ros2, robot, goal + np.array([0, 0, 0.4])) is None  # not facing the PoI
    assert see(ros2, robot, goal, age=0.31) is None  # too old
    moved = [
        ros2.Scan(9.1 - turn, goal + np.array([0, 0, turn]), OWN, np.ones(9)) for turn in (0.02, 0)
    ]
    assert [robot.see(9.1, scan) for scan in moved] == [None, None]
    assert stub.asked == []
    assert see(ros2, robot, goal, age=0.29) is not None


@pytest.mark.parametrize(
    ("speed", "period", "looks"),
    [
        (0.3, 1 / 40, False),
        (0.3, 1 / 10, False),
        (0.05, 1 / 40, True),
        (0.05, 1, False),
        (0, 1, True),
    ],
)
def test_whether_a_robot_stands_still_does_not_depend_on_the_rate_of_scans(
    ros2, robot, speed, period, looks
):
    goal = arrive(robot)
    away = goal - np.array([speed * period, 0, 0])
    assert robot.see(9.0, ros2.Scan(9.0, away, OWN, np.ones(9))) is None
    scan = ros2.Scan(9.0 + period, goal, OWN, np.ones(9))
    assert (robot.see(9.0 + period, scan) is not None) == looks


def test_the_same_scan_twice_does_not_tell_that_a_robot_stands_still(ros2, robot):
    scan = ros2.Scan(9.0, arrive(robot), OWN, np.ones(9))
    assert [robot.see(9.0, scan) for _ in range(2)] == [None, None]


def test_a_look_updates_the_map_and_the_next_choice_is_new(ros2, robot, stub):
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
    assert np.linalg.norm(again[:2] - POSITIONS[0]) == pytest.approx(0.9)


def test_a_robot_under_way_keeps_its_viewpoint_unless_it_changes_its_mind(ros2, robot, stub):
    goal = arrive(robot)
    report = ros2.Robot(CONTENTS, stub.programs(), 0, POSITIONS).report()
    look = {"poi": 2, "features": [0.75, 0.25], "weight": 1.0, "place": [-1.1, 0.0]}
    told = report.replace('"look": null', f'"look": {look}'.replace("'", '"'))
    robot.hear(0.0, told)
    assert arrive(robot, (0.2, 0.3, 0.0)) is goal
    robot.hear(0.0, told)
    stub.choices = [1, 3]
    np.testing.assert_allclose(arrive(robot), [0, 1.1, math.pi / 2], atol=1e-9)
    # No news, no choice.
    stub.choices = [3]
    assert arrive(robot) is not None


def test_after_failures_elsewhere_a_poi_is_given_up(ros2, robot, stub):
    stub.detects = False
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


def test_a_poi_that_is_seen_from_everywhere_is_given_up(robot, stub):
    stub.weigh = lambda apart: {"weight": 0.4}
    robot.programs = stub.programs()
    assert arrive(robot) is None
    assert robot.is_done


def test_a_scan_that_is_too_narrow_for_the_detector_is_refused(ros2, robot, stub):
    with pytest.raises(ValueError, match=r"field of view = 20.0 degrees: must be at least 30.0"):
        see(ros2, robot, arrive(robot), np.radians(np.arange(-10, 11, 10.0)))
    assert stub.asked == []


def test_a_robot_ends_by_nop(robot, stub):
    stub.choices = [3]
    assert arrive(robot) is None
    assert robot.is_done
    assert '"works": false' in robot.report()
    robot.fail(np.zeros(3))
    assert robot.team["present"].all()


def test_an_archive_that_does_not_fit_is_named(ros2, stub):
    with pytest.raises(ValueError, match="2 PoIs: the policy of this archive is for 3"):
        ros2.Robot(CONTENTS, stub.programs(), 1, POSITIONS[:2])
    programs = {**stub.programs(), "merge": None}
    with pytest.raises(ValueError, match="maps of their own"):
        ros2.Robot(CONTENTS, programs, 1, POSITIONS)


@pytest.mark.parametrize("index", [-1, 2])
def test_a_robot_that_the_archive_lacks_is_named(ros2, stub, index):
    expected = f"robot = {index}: must be one of {{0: 'camera', 1: 'lidar'}}"
    with pytest.raises(ValueError, match=re.escape(expected)):
        ros2.Robot(CONTENTS, stub.programs(), index, POSITIONS)


@pytest.mark.parametrize(
    ("positions", "expected"),
    [
        ([[0, 1], [1, 2], [math.nan, 0]], "must be two finite numbers each"),
        ([[0, 1, 2], [1, 2, 2], [1, 0, 2]], "must be two finite numbers each"),
        ([[0, 1], [1, 2], [0, 1]], "must differ from each other"),
    ],
)
def test_places_of_no_pois_are_named(ros2, stub, positions, expected):
    with pytest.raises(ValueError, match=rf"positions = \[\[0.0, 1.0.*: {expected}"):
        ros2.Robot(CONTENTS, stub.programs(), 1, np.array(positions))
