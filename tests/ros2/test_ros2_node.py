"""The robot of the node for ROS 2, without ROS."""

import copy
import dataclasses
import json
import math
import re
import sys
from types import SimpleNamespace
from unittest.mock import MagicMock

import jax
import numpy as np
import pytest
from ros2_messages import LaserScan

from jaxsense.sim import resampling

POSITIONS = np.array([[2.0, 0.0], [0.0, 2.0], [-2.0, 0.0]])
OWN = np.radians(np.arange(-40, 41, 10.0))  # nine beams, from right to left
CONTENTS = {
    "modalities": ["camera", "lidar"],
    "robots": ["camera", "lidar"],
    "classes": ["a", "b"],
    "labels": {"camera": ["red", "green"], "lidar": ["cylinder", "cube"]},
    "unseen": {"mean": [0.0], "std": [4.5]},
    "sensors": {"lidar": {"angles": OWN.tolist(), "window": math.radians(30.0)}},
    "viewpoint": {"min_distance": 0.3, "max_distance": 1.2, "max_bearing": 0.35},
    "mission": {"attempts": 3},
    "remembered_looks": 2,
    "programs": {"decide": {"inputs": {"positions": {"shape": [3, 2]}}}},
}


class Stub:
    """Programs that remember what they were asked; chooses PoIs in order, and detects."""

    def __init__(self):
        self.detects, self.asked, self.choices = True, [], [0, 1, 2, 3]

    def programs(self):
        writes = {f"write_{name}": self.write for name in CONTENTS["robots"]}
        weighs = {f"weigh_{name}": self.weigh for name in CONTENTS["robots"]}
        own = {"decide": self.decide, "detect_lidar": self.detect, "classify": self.classify}
        return {**own, **writes, **weighs}

    def classify(self, mean, std):
        return {"probabilities": np.stack([mean[:, 0], 1 - mean[:, 0]], axis=1)}

    def decide(self, present, **_):
        return {"action": next(n for n in self.choices if n == 3 or present[n])}

    def detect(self, **given):
        self.asked.append(given)
        return {"detects": self.detects, "features": np.array([0.75, 0.25])}

    def weigh(self, apart):
        return {"weight": 0.0 if (apart < 0.5).any() else 1.0}

    def write(self, mean, std, seen, features, weight):
        return {"new_mean": mean + weight * features[0], "new_std": std / 2}


@pytest.fixture
def stub():
    return Stub()


@pytest.fixture
def robot(ros2, stub):
    return ros2.Robot(CONTENTS, stub.programs(), resampling.resample, 1, POSITIONS)


def arrive(robot, pose=(0.0, 0.0, 0.0)):
    """Lets a robot choose at a pose, and gives the pose where it then goes."""
    robot.choose(0.0, np.array(pose))
    return robot.goal


def see(ros2, robot, pose, angles=OWN, readings=None, age=0.0):
    """The look of a robot that arrives at a pose, and stands still in the second scan."""
    readings = np.full(len(angles), 1.0) if readings is None else np.asarray(readings)
    scan = ros2.Scan(9.0 - age, np.asarray(pose, float), angles, readings)
    before = [dataclasses.replace(scan, stamp=scan.stamp - ago) for ago in (0.2, 0.1)]
    robot.see(9.0, dataclasses.replace(before[0], pose=scan.pose + 1))
    first, second = [robot.see(9.0, each) for each in (before[1], scan)]
    assert first is None
    return second


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


def test_a_scanner_that_is_too_coarse_is_refused_before_the_robot_drives(ros2, robot, stub):
    assert ros2.MAX_STEPS == resampling.MAX_STEPS
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
    other = ros2.Robot(CONTENTS, stub.programs(), resampling.resample, 0, POSITIONS)
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
    report = ros2.Robot(CONTENTS, stub.programs(), resampling.resample, 0, POSITIONS).report()
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


def test_robots_tell_each_other_their_looks(ros2, robot, stub):
    other = ros2.Robot(CONTENTS, stub.programs(), resampling.resample, 0, POSITIONS)
    look = see(ros2, robot, goal := arrive(robot))
    robot.choose(1.0, goal)
    for hears in (other, robot):  # its own report changes nothing
        hears.hear(1.0, robot.report(look))
        np.testing.assert_allclose(hears.known["mean"][:, 0], [0.75, 0, 0])
        np.testing.assert_array_equal(hears.known["seen"][0], [False, True])
        assert np.isfinite(hears.known["looked_from"][0, 1]).all(axis=1).sum() == 1
    np.testing.assert_allclose(other.team["poses"][1], goal, atol=1e-6)
    assert other.team["target"].tolist() == [3, 0]
    assert other.team["works"].tolist() == [True, True]
    # A robot that says nothing for five seconds has failed; one that never spoke is not there.
    other.choose(6.0, np.zeros(3))
    assert other.team["works"].tolist() == [True, True]
    other.choose(6.1, np.zeros(3))
    assert other.team["works"].tolist() == [True, False]
    assert robot.team["works"].tolist() == [False, True]


LOOK = {"poi": 2, "features": [0.75, 0.25], "weight": 1.0, "place": [-1.1, 0.0]}
REPORT = {"robot": 0, "pose": [1, 1, 0], "target": 1, "works": True, "look": LOOK}
MALFORMED = {
    "": "JSONDecodeError",
    "[" * 100_000: "RecursionError",
    "[]": "TypeError",
    "{}": "KeyError('robot')",
    json.dumps({**REPORT, "robot": 2}): "robot = 2: must be an integer from 0 to 1",
    json.dumps({**REPORT, "robot": -1}): "robot = -1: must be an integer from 0 to 1",
    json.dumps({**REPORT, "pose": [1, 1]}): "pose = [1, 1]: must be finite numbers of shape (3,)",
    json.dumps({**REPORT, "pose": [1, 1, math.nan]}): "pose = [1, 1, nan]: must be finite",
    json.dumps({**REPORT, "target": 4}): "target = 4: must be an integer from 0 to 3",
    json.dumps({**REPORT, "look": {**LOOK, "poi": -1}}): "poi = -1: must be an integer from 0 to 2",
    json.dumps({**REPORT, "look": {**LOOK, "place": [0]}}): "place = [0]: must be finite numbers",
    json.dumps({**REPORT, "look": {**LOOK, "weight": None}}): "weight = None: must be finite",
    json.dumps({**REPORT, "works": "false"}): "KeyError('false')",
    json.dumps({**REPORT, "look": {**LOOK, "weight": 7}}): "weight = 7.0: must be from 0 to 1",
    json.dumps(
        {**REPORT, "look": {**LOOK, "features": [math.inf, 0]}}
    ): "features = [inf, 0]: must",
    json.dumps({**REPORT, "look": {**LOOK, "features": [1, 0, 0]}}): "of shape (2,)",
    json.dumps(
        {**REPORT, "look": {**LOOK, "features": [2, -1]}}
    ): "features = [2.0, -1.0]: must be from 0 to 1",
}


@pytest.mark.parametrize("report", MALFORMED, ids=MALFORMED.values())
def test_a_message_that_is_no_report_changes_nothing(robot, report):
    before = copy.deepcopy((robot.team, robot.known, robot._heard_at))
    with pytest.raises(ValueError, match=re.escape(MALFORMED[report])):
        robot.hear(1.0, report)
    jax.tree.map(np.testing.assert_array_equal, (robot.team, robot.known, robot._heard_at), before)


@pytest.fixture
def node(monkeypatch):
    """A node of `rclpy`, for which the packages of ROS are stand-ins."""
    for name in ("geometry_msgs", "rclpy", "sensor_msgs", "std_msgs", "tf2_ros"):
        for part in ("", ".duration", ".msg", ".qos", ".time"):
            monkeypatch.setitem(sys.modules, name + part, MagicMock())
    node = MagicMock()
    node.get_clock().now().nanoseconds = 10**9
    return node


def callback_of(node, topic):
    given = (call.args for call in node.create_subscription.call_args_list)
    (callback,) = (callback for _, each, callback, _ in given if each == topic)
    return callback


def test_a_coarse_scan_gets_one_line_and_no_goal(ros2, robot, node, monkeypatch):
    monkeypatch.setattr(ros2, "pose_of", lambda *_: (np.zeros(3), False))
    sys.modules["rclpy.time"].Time.from_msg.return_value.nanoseconds = 10**9
    sys.modules["tf2_ros"].TransformException = OSError
    ros2.connect(node, robot)
    on_scan, goals = callback_of(node, "scan"), node.create_publisher.return_value
    for step, number in ((math.radians(35), 0), (OWN[1] - OWN[0], 1)):
        scan = LaserScan(OWN[0], step, np.ones(9))
        scan.header = MagicMock()
        on_scan(scan)
        assert goals.publish.call_count == number
    (said,) = node.get_logger().error.call_args_list
    assert "ignores the scans: step between beams = 35.00 degrees" in said.args[0]
    assert said.kwargs == {"once": True}


def test_a_scan_that_is_too_narrow_for_the_detector_is_refused(ros2, robot, stub):
    with pytest.raises(ValueError, match=r"field of view = 20.0 degrees: must be at least 30.0"):
        see(ros2, robot, arrive(robot), np.radians(np.arange(-10, 11, 10.0)))
    assert stub.asked == []


def test_the_node_logs_what_goes_wrong_and_says_what_stands_where(ros2, robot, stub, node):
    stub.detects, goal = False, arrive(robot)
    for _ in range(3):
        assert see(ros2, robot, goal) is None
        goal = arrive(robot, goal)
    stub.choices = [3]
    robot._has_news = True
    arrive(robot)
    ros2.log(node, robot)
    logged = [call.args[0] for call in node.get_logger().info.call_args_list]
    assert logged[0] == "nothing detected of PoI 0, 0.90 m away"
    assert logged[1] == "failure 1 of 3 at PoI 0"
    assert logged[-2:] == ["gives PoI 0 up", "done: no further look is worth its cost"]
    assert robot.notes == []
    tell = ros2.join(node, robot, lambda: 1.0)
    robot.known["mean"][1] = 0.75
    string = sys.modules["std_msgs.msg"].String
    tell()
    (_, classes) = (json.loads(call.kwargs["data"]) for call in string.call_args_list[-2:])
    assert classes == [{"a": 0.0, "b": 1.0}, {"a": 0.75, "b": 0.25}, {"a": 0.0, "b": 1.0}]


def test_a_message_that_is_no_report_does_not_end_the_node(ros2, robot, node):
    ros2.connect(node, robot)
    hear = callback_of(node, "team")
    hear(SimpleNamespace(data="nonsense"))
    (warned,) = node.get_logger().warning.call_args_list
    assert "ignored a message on `team`: no report of a robot" in warned.args[0]
    assert warned.kwargs == {"once": True}
    hear(SimpleNamespace(data=json.dumps(REPORT)))
    assert robot.known["seen"][2, 0]
    assert robot._heard_at[0] == pytest.approx(1)


def test_a_robot_ends_by_nop(robot, stub):
    stub.choices = [3]
    assert arrive(robot) is None
    assert robot.is_done
    assert '"works": false' in robot.report()
    robot.fail(np.zeros(3))
    assert robot.team["present"].all()


def test_an_archive_that_does_not_fit_is_named(ros2, stub):
    with pytest.raises(ValueError, match="2 PoIs: the policy of this archive is for 3"):
        ros2.Robot(CONTENTS, stub.programs(), resampling.resample, 1, POSITIONS[:2])
    programs = {**stub.programs(), "merge": None}
    with pytest.raises(ValueError, match="maps of their own"):
        ros2.Robot(CONTENTS, programs, resampling.resample, 1, POSITIONS)


@pytest.mark.parametrize("index", [-1, 2])
def test_a_robot_that_the_archive_lacks_is_named(ros2, stub, index):
    expected = f"robot = {index}: must be one of {{0: 'camera', 1: 'lidar'}}"
    with pytest.raises(ValueError, match=re.escape(expected)):
        ros2.Robot(CONTENTS, stub.programs(), resampling.resample, index, POSITIONS)


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
        ros2.Robot(CONTENTS, stub.programs(), resampling.resample, 1, np.array(positions))
