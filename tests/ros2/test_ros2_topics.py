"""What robots of the node for ROS 2 tell each other, and what the node publishes and logs."""

import copy
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
from ros2_robot import CONTENTS, OWN, POSITIONS, arrive, see


def test_robots_tell_each_other_their_looks(ros2, robot, stub):
    other = ros2.Robot(CONTENTS, stub.programs(), 0, POSITIONS)
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


def test_the_node_logs_what_goes_wrong_and_says_what_stands_where(ros2, robot, stub, node):
    stub.detects, goal = False, arrive(robot)
    for stub.is_known in (True, False, True):
        assert see(ros2, robot, goal) is None
        goal = arrive(robot, goal)
    stub.choices = [3]
    robot._has_news = True
    arrive(robot)
    ros2.log(node, robot)
    logged = [call.args[0] for call in node.get_logger().info.call_args_list]
    assert logged[0] == "nothing detected of PoI 0, 0.90 m away"
    assert logged[1] == "failure 1 of 3 at PoI 0"
    assert logged[2] == "outside of what was recorded or learned: PoI 0, 0.90 m away"
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
