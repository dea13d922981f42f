"""A ROS 2 node by which a robot takes part in a mission, with an exported run and onnxruntime.

    jaxsense export pretrained:noisy --out robot.zip
    python3 ros2_node.py robot.zip --robot 1 --pois 1.0,0.5 -1.2,0.8 0.3,-1.1

Copy this file, `ros2_readings.py`, `run_exported.py`, the archive, and `interfaces/robot.py` and
`recorded/resampling.py` of jaxsense to the robot. `--pois` says where the points of interest (PoIs)
stand in the frame `map`. `docs/robot.md` lists the topics.
"""
# ruff: noqa: PLC0415

import argparse
import itertools
import json
import math
import re
import sys
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

try:
    import run_exported
    from ros2_readings import beams, pose_of, scanline, turned, wrapped
    from run_exported import imported, load, require
except ModuleNotFoundError as error:
    if error.name not in ("run_exported", "ros2_readings"):
        raise
    sys.exit(f"needs {error.name}.py: copy it next to this file")

resampling = imported("resampling", "jaxsense.recorded")

VIEW_DISTANCE = 0.9  # m, from the sensor to a PoI
VIEW_SIDES = 16  # directions around a PoI that are tried
CLEARANCE = 0.3  # m, from a viewpoint to other PoIs and robots, and to where a look has failed
AT_GOAL = 0.3  # m, from a viewpoint within which the robot looks
MAX_AGE = 0.3  # s, of a scan
STILL = np.array([0.1, 0.1, 0.1])  # m/s, m/s and rad/s, up to which the robot stands still
STILL_FOR = 0.1  # s, within which a robot that stands still moves by no more than that
PATIENCE = 60.0  # s, after which a robot that has not looked gives its viewpoint up
NEW = 0.5  # share of a look that must be new


class Scan(NamedTuple):
    """Time in seconds; pose of the robot then in the frame `map`; and readings along angles."""

    stamp: float
    pose: np.ndarray
    angles: np.ndarray
    readings: np.ndarray


class Robot(run_exported.Robot):
    """A robot in a mission: from where it looks, and what its scans say.

    Attributes:
      mounting: pose of the sensor on the robot, x and y in metres and yaw in radians.
      is_upside_down: whether the sensor is.
      target: the PoI that it looks at next; None before its first choice, and when it is done.
      goal: pose from which it does so, in the frame `map`; None if it must choose.
      say: tells people what happens.
    """

    def __init__(self, contents: dict, programs: dict, robot: int, positions: Any):
        """A robot before its first look, see `run_exported.Robot`."""
        super().__init__(contents, programs, robot, positions)
        require(
            "merge" not in programs, "robots have maps of their own: see `tell` in run_exported"
        )
        self.mounting, self.is_upside_down, self.target, self.goal = np.zeros(3), False, None, None
        self.say, self._has_news = print, True
        self._last_stamp, self._last_pose = -np.inf, np.full(3, np.inf)
        self._failed_at: list[list[np.ndarray]] = [[] for _ in positions]

    def write(self, robot: int, look: dict[str, Any]) -> None:
        """Updates the map by a look of any robot, after which it chooses anew."""
        super().write(robot, look)
        self._has_news = True

    def choose(self, now: float, pose: np.ndarray) -> None:
        """Sets target and goal by the policy, if the map is new since the last choice."""
        self.team["poses"][self.robot] = pose
        if self.is_done or not self._has_news:
            return
        self._has_news = False
        while (chosen := self.decide(now)) is not None:
            # Under way to the same PoI, it keeps its viewpoint.
            if chosen != self.target or self.goal is None:
                self.target, self.goal = chosen, self._viewpoint(chosen)
            if self.goal is not None:
                return
            self.team["present"][chosen] = False
            self.say(f"gives PoI {chosen} up: nowhere is left to look from")
        self.target, self.goal = None, None
        self.say("done: no further look is worth its cost")

    def see(self, now: float, scan: Scan) -> dict[str, Any] | None:
        """Looks at the target, if the robot stands still at its goal and the scan is recent.

        Returns the look by which it has updated the map, for `report`; None if there was none.
        """
        about = self.contents["sensors"][self.name]
        own = np.array(about["angles"])
        width, window = np.degrees([np.ptp(scan.angles), about["window"]])
        require(
            width >= window, f"field of view = {width:.1f} degrees: must be {window:.1f} or more"
        )
        step, most = np.degrees([np.median(np.abs(np.diff(each))) for each in (scan.angles, own)])
        most *= resampling.MAX_STEPS
        require(step <= most, f"step of beams = {step:.2f} degrees: must be {most:.2f} or less")
        elapsed, moved = scan.stamp - self._last_stamp, np.abs(scan.pose - self._last_pose)
        self._last_stamp, self._last_pose = scan.stamp, scan.pose.copy()
        # Over a long time, a mean speed says little about that of now.
        is_still = elapsed > 0 and (moved <= STILL * min(elapsed, STILL_FOR)).all()
        if self.goal is None or not is_still or abs(now - scan.stamp) > MAX_AGE:
            return None
        place, limits = scan.pose[:2], self.contents["viewpoint"]
        away = self.team["positions"][self.target] - place
        away = away - turned(self.mounting[:2], scan.pose[2])
        ahead = scan.pose[2] + self.mounting[2]
        distance, bearing = math.hypot(*away), wrapped(math.atan2(away[1], away[0]) - ahead)
        is_there = np.linalg.norm(place - self.goal[:2]) <= AT_GOAL
        is_there &= limits["min_distance"] <= distance <= limits["max_distance"]
        if not is_there or abs(bearing) > limits["max_bearing"]:
            return None
        angles, readings = (-1 if self.is_upside_down else 1) * scan.angles, scan.readings
        is_lidar = readings.ndim == 1
        if is_lidar:
            readings = resampling.close_gaps(angles, readings, step=resampling.median_step(own))
        readings = resampling.resample(own, angles, readings, measures_distance=is_lidar)
        detect = self.programs[f"detect_{self.name}"]
        found = detect(readings=readings, bearing=bearing, distance=distance)
        if found["detects"]:
            self.goal = None
            return self.look(self.target, place, found["features"])
        why = "nothing detected of" if found["is_known"] else "outside of what was learned:"
        self.say(f"{why} PoI {self.target}, {distance:.2f} m away")
        self.fail(scan.pose)
        return None

    def fail(self, pose: np.ndarray) -> None:
        """Gives up the viewpoint from which it did not detect the PoI, and at last the PoI."""
        if self.target is None:
            return
        self.goal, self._has_news = None, True
        self._failed_at[self.target].append(pose[:2])
        failures, attempts = len(self._failed_at[self.target]), self.contents["mission"]["attempts"]
        self.team["present"][self.target] = failures < attempts
        self.say(f"failure {failures} of {attempts} at PoI {self.target}")

    def _viewpoint(self, poi: int) -> np.ndarray | None:
        """The robot's nearest pose from which it has not failed and a look is new, if any."""
        positions, here = self.team["positions"], self.team["poses"][self.robot, :2]
        others = self.team["poses"][np.isfinite(self.heard_at), :2]
        failed = np.reshape(self._failed_at[poi], (-1, 2))
        avoided, found = np.concatenate([np.delete(positions, poi, 0), others, failed]), []
        for side in 2 * np.pi * np.arange(VIEW_SIDES) / VIEW_SIDES:
            yaw = wrapped(side + np.pi - self.mounting[2])
            sensor = positions[poi] + turned(np.array([VIEW_DISTANCE, 0]), side)
            place = sensor - turned(self.mounting[:2], yaw)
            is_free = (np.linalg.norm(avoided - place, axis=1) >= CLEARANCE).all()
            if is_free and self.weight(poi, place) >= NEW:
                found.append(np.append(place, yaw))
        return min(found, key=lambda pose: np.linalg.norm(pose[:2] - here), default=None)


def join(node: Any, robot: Robot, now: Callable[[], float]) -> Callable[..., None]:
    """Lets a robot hear the others; returns what tells them each second, and of a look."""
    from std_msgs.msg import String

    team = node.create_publisher(String, "team", 100)
    classes = node.create_publisher(String, "classes", 1)

    def tell(look: dict[str, Any] | None = None) -> None:
        team.publish(String(data=robot.report(look)))
        rows = robot.classes("probabilities").tolist()
        named = [dict(zip(robot.contents["classes"], row, strict=True)) for row in rows]
        classes.publish(String(data=json.dumps(named)))

    def hear(message: Any) -> None:
        try:
            robot.hear(now(), message.data)
        except ValueError as error:
            node.get_logger().warning(f"ignored a message on `team`: {error}", once=True)

    node.create_subscription(String, "team", hear, 100)
    node.create_timer(1.0, tell)
    return tell


def connect(node: Any, robot: Robot) -> Any:
    """Connects a robot to topics and transforms; returns what must live as long as the node."""
    from geometry_msgs.msg import PoseStamped
    from rclpy.duration import Duration
    from rclpy.qos import qos_profile_sensor_data
    from rclpy.time import Time
    from sensor_msgs.msg import CameraInfo, Image, LaserScan
    from tf2_ros import Buffer, TransformException, TransformListener

    buffer, logger, is_camera = Buffer(), node.get_logger(), robot.name == "camera"
    infos, set_out_at, robot.say = deque(maxlen=1), 0.0, logger.info
    goals = node.create_publisher(PoseStamped, "goal_pose", 1)

    def now() -> float:
        return node.get_clock().now().nanoseconds * 1e-9

    tell = join(node, robot, now)

    def pose(parent: str, child: str, when: Any, is_optical: bool = False) -> Any:
        found = buffer.lookup_transform(parent, child, when, Duration(seconds=0.1))
        return pose_of(found.transform, is_optical)

    def on_reading(message: Any) -> None:
        nonlocal set_out_at
        if is_camera and not infos:
            return
        stamp, frame = Time.from_msg(message.header.stamp), message.header.frame_id
        try:
            at, _ = pose("map", "base_link", stamp)
            robot.mounting, robot.is_upside_down = pose("base_link", frame, Time(), is_camera)
            read = scanline(message, infos[0]) if is_camera else beams(message)
            look = robot.see(now(), Scan(stamp.nanoseconds * 1e-9, at, *read))
        except TransformException as error:
            logger.warning(f"no pose for a scan: {error}")
            return
        except ValueError as error:
            logger.error(f"ignores the scans: {error}", once=True)
            return
        if look is not None:
            tell(look)
        elif robot.goal is not None and now() - set_out_at > PATIENCE:
            robot.say(f"has not looked within {PATIENCE:.0f} s")
            robot.fail(at)
        before = robot.goal
        robot.choose(now(), at)
        if robot.goal is not None and robot.goal is not before:
            set_out_at, goal = now(), PoseStamped()
            goal.header.frame_id, goal.header.stamp = "map", node.get_clock().now().to_msg()
            (x, y, yaw), place, turn = (
                robot.goal.tolist(),
                goal.pose.position,
                goal.pose.orientation,
            )
            place.x, place.y, turn.z, turn.w = x, y, math.sin(yaw / 2), math.cos(yaw / 2)
            goals.publish(goal)

    kind, topic = (Image, "image") if is_camera else (LaserScan, "scan")
    node.create_subscription(kind, topic, on_reading, qos_profile_sensor_data)
    if is_camera:
        node.create_subscription(CameraInfo, "camera_info", infos.append, qos_profile_sensor_data)
    return TransformListener(buffer, node, spin_thread=True)


def point(text: str) -> list[float]:
    """The numbers of `X,Y`, in metres."""
    x, y = map(float, text.split(","))
    return [x, y]


def main() -> None:
    """Runs the node."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("archive", type=Path, help="file of `jaxsense export`")
    parser.add_argument("--robot", type=int, default=0, help="index of this robot in the run")
    meaning = "positions of the PoIs, in metres"
    parser.add_argument("--pois", nargs="+", required=True, type=point, metavar="X,Y", help=meaning)
    own = itertools.takewhile(lambda each: each != "--ros-args", sys.argv[1:])
    # With a space before it, argparse takes -1.2,0.8 for no option.
    arguments = parser.parse_args(
        [f" {each}" if re.match(r"-\.?\d", each) else each for each in own]
    )
    try:
        robot = Robot(*load(arguments.archive), arguments.robot, arguments.pois)
    except ValueError as error:
        parser.error(str(error))
    try:
        import rclpy
    except ImportError:
        sys.exit("needs ROS 2: source /opt/ros/.../setup.bash")
    rclpy.init(args=sys.argv)
    node = rclpy.create_node(f"jaxsense_{arguments.robot}")
    listener = connect(node, robot)
    rclpy.spin(node)
    del listener


if __name__ == "__main__":
    main()
