"""A ROS 2 node by which a robot takes part in a mission, with an exported run and onnxruntime.

    jaxsense export pretrained:noisy --out robot.zip
    python3 ros2_node.py robot.zip --robot 1 --pois 1.0,0.5 -1.2,0.8 0.3,-1.1

Copy this file, `run_exported.py`, the archive, and `interfaces/robot.py` and
`recorded/resampling.py` of jaxsense to the robot. `--robot` says which robot of the run it is,
`--pois` where the points of interest (PoIs) stand in the frame `map`. The node reads `scan`
(sensor_msgs/LaserScan), or `image` and `camera_info` (sensor_msgs/Image, rectified), and the
transforms between `map`, `base_link` and the sensor. It publishes from where to look as `goal_pose`
(geometry_msgs/PoseStamped), to which Nav2 drives, exchanges looks with the other robots on `team`,
and says on `classes` what each PoI probably is (both std_msgs/String, JSON).

The functions and the class `Robot` do the work; they read messages by their fields alone, so that
they run and are tested where there is no ROS. `main` connects them to topics.
"""
# ruff: noqa: PLC0415

import argparse
import collections
import dataclasses
import itertools
import json
import math
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

try:
    from run_exported import Programs, empty, imported, load, remember, write
except ModuleNotFoundError as error:
    if error.name != "run_exported":
        raise
    sys.exit("needs run_exported.py: copy it next to this file")

resampling = imported("resampling", "jaxsense.sim")

VIEW_DISTANCE = 0.9  # m, from the sensor to a PoI
VIEW_SIDES = 16  # directions around a PoI that are tried
CLEARANCE = 0.3  # m, from a viewpoint to other PoIs and robots, and to where a look has failed
AT_GOAL = 0.3  # m, from a viewpoint within which the robot looks
MAX_AGE = 0.3  # s, of a scan
STILL = np.array([0.1, 0.1, 0.1])  # m/s, m/s and rad/s, up to which the robot stands still
STILL_FOR = 0.1  # s, within which a robot that stands still moves by no more than that
SILENCE = 5.0  # s, after which a robot that tells nothing counts as failed
PATIENCE = 60.0  # s, after which a robot that has not looked gives its viewpoint up
NEW = 0.5  # share of a look that must be new

_ENCODINGS = {"rgb8": [0, 1, 2], "rgba8": [0, 1, 2], "bgr8": [2, 1, 0], "bgra8": [2, 1, 0]}


def beams(scan: Any) -> tuple[np.ndarray, np.ndarray]:
    """Angles, in radians, and distances, in metres, of a `sensor_msgs/LaserScan`.

    Drivers write infinity, NaN, 0 or a distance out of range for a beam without a return; here it
    is infinite. Minus infinity, for something too near to be measured, stays: where it covers the
    PoI, a look shows nothing.
    """
    ranges = np.asarray(scan.ranges, np.float32)
    has_return = (ranges >= scan.range_min) & (ranges <= scan.range_max)
    ranges = np.where(has_return | np.isneginf(ranges), ranges, np.inf)
    return scan.angle_min + scan.angle_increment * np.arange(len(ranges)), ranges


def scanline(image: Any, info: Any) -> tuple[np.ndarray, np.ndarray]:
    """Angles, in radians, and linear RGB, from 0 to 1, of the row of a picture at the horizon.

    Args:
      image: a rectified `sensor_msgs/Image` of a level camera, with 8 bits for each channel.
      info: its `sensor_msgs/CameraInfo`, whose matrix P belongs to rectified images.

    Raises:
      ValueError: if the encoding is another, the camera is not calibrated, or the calibration is
        of images of another size.
    """
    if image.encoding not in _ENCODINGS:
        expected = f"must be one of {', '.join(_ENCODINGS)}"
        raise ValueError(f"encoding = {image.encoding!r}: {expected}")
    if len(info.p) < 7 or not np.isfinite(info.p).all():
        raise ValueError(
            f"P of camera_info = {list(info.p)}: must be finite numbers of a 3 x 4 matrix"
        )
    focal_length, middle, row = info.p[0], info.p[2], round(info.p[6])
    if not focal_length > 0:
        raise ValueError(f"P[0] of camera_info = {focal_length}: must be above 0; calibrate first")
    if (info.width, info.height) != (image.width, image.height):
        size = f"{info.width} x {info.height}"
        raise ValueError(f"camera_info is of {size} pixels: must be {image.width} x {image.height}")
    if not 0 <= row < image.height:
        raise ValueError(f"P[6] of camera_info = {row}: must be a row from 0 to {image.height - 1}")
    channels = len(image.encoding.removesuffix("8"))
    if image.step < image.width * channels or len(image.data) < image.height * image.step:
        expected = f"must be {image.height} rows of {image.width * channels} or more"
        raise ValueError(f"data of {len(image.data)} bytes in rows of {image.step}: {expected}")
    line = np.frombuffer(bytes(image.data), np.uint8)[row * image.step :][: image.step]
    pixels = line[: image.width * channels].reshape(-1, channels)[:, _ENCODINGS[image.encoding]]
    # The inverse of sRGB's gamma.
    value = pixels / 255
    linear = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    angles = np.arctan2(middle - np.arange(image.width), focal_length)
    return angles, linear.astype(np.float32)


def pose_of(transform: Any, is_optical: bool = False) -> tuple[np.ndarray, bool]:
    """Pose in the plane of a `geometry_msgs/Transform`.

    Args:
      transform: of a frame.
      is_optical: whether the frame looks along z, with x to the right, as those of cameras do;
        otherwise along x, with y to the left.

    Returns:
      x and y, in metres, and yaw, in radians; and whether the frame is upside down.

    Raises:
      ValueError: if the frame looks up or down.
    """
    q, place = transform.rotation, transform.translation
    forward = {
        False: (1 - 2 * (q.y**2 + q.z**2), 2 * (q.x * q.y + q.z * q.w)),
        True: (2 * (q.x * q.z + q.y * q.w), 2 * (q.y * q.z - q.x * q.w)),
    }[is_optical]
    if math.hypot(*forward) < 0.5:
        kind = "z ahead, as an optical frame" if is_optical else "x ahead"
        raise ValueError(f"the frame looks up or down: must have {kind}")
    up = -2 * (q.y * q.z + q.x * q.w) if is_optical else 1 - 2 * (q.x**2 + q.y**2)
    return np.array([place.x, place.y, math.atan2(forward[1], forward[0])]), up < 0


def write_pose(message: Any, pose: np.ndarray) -> None:
    """Writes x and y, in metres, and yaw, in radians, into a `geometry_msgs/Pose`."""
    at, turned = message.position, message.orientation
    at.x, at.y = float(pose[0]), float(pose[1])
    turned.z, turned.w = math.sin(pose[2] / 2), math.cos(pose[2] / 2)


def compose(frame: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """A pose in a frame, such as a sensor's on a robot, as a pose in the frame's own parent."""
    (x, y, yaw), (ahead, left, turn) = frame, pose
    sine, cosine = math.sin(yaw), math.cos(yaw)
    return np.array(
        [x + cosine * ahead - sine * left, y + sine * ahead + cosine * left, wrapped(yaw + turn)]
    )


def inverse(pose: np.ndarray) -> np.ndarray:
    """The parent's pose in the frame of a pose."""
    x, y, yaw = pose
    sine, cosine = math.sin(yaw), math.cos(yaw)
    return np.array([-cosine * x - sine * y, sine * x - cosine * y, -yaw])


def wrapped(angle: float) -> float:
    """An angle in radians, from -pi to pi."""
    return (angle + math.pi) % (2 * math.pi) - math.pi


def index(name: str, value: Any, number: int) -> int:
    """A value of a report that must be an integer from 0, less than `number`."""
    if type(value) is not int or not 0 <= value < number:
        raise ValueError(f"{name} = {value!r}: must be an integer from 0 to {number - 1}")
    return value


def finite(name: str, value: Any, shape: tuple[int, ...]) -> np.ndarray:
    """A value of a report that must hold finite numbers."""
    found = np.asarray(value, np.float32)
    if found.shape != shape or not np.isfinite(found).all():
        raise ValueError(f"{name} = {value!r}: must be finite numbers of shape {shape}")
    return found


def within(name: str, value: np.ndarray) -> None:
    """Raises `ValueError` unless all numbers of a report are from 0 to 1."""
    if not ((value >= 0) & (value <= 1)).all():
        raise ValueError(f"{name} = {value.tolist()}: must be from 0 to 1")


@dataclasses.dataclass(frozen=True)
class Scan:
    """What a sensor has read.

    Attributes:
      stamp: when, in seconds.
      pose: where the robot was then, x and y in metres and yaw in radians, in the frame `map`.
      angles: directions of the rays in the sensor's frame, in radians, positive to the left.
      readings: distances in metres, or linear RGB, along these rays.
    """

    stamp: float
    pose: np.ndarray
    angles: np.ndarray
    readings: np.ndarray


class Robot:
    """A robot in a mission: what it knows, which PoI it looks at next, and from where.

    Attributes:
      name: of its modality.
      mounting: pose of the sensor on the robot, x and y in metres and yaw in radians.
      is_upside_down: whether the sensor is.
      target: the PoI that it looks at next; None before its first choice, and when it is done.
      goal: pose from which it does so, in the frame `map`; None if it must choose.
      team: what it knows of all robots and PoIs, as `decide` reads it.
      known: the map.
      notes: what has happened since somebody last emptied the list, for people to read.
    """

    def __init__(
        self,
        contents: dict[str, Any],
        programs: Programs,
        robot: int,
        positions: np.ndarray,
    ):
        """A robot before its first look.

        Args:
          contents: of the archive.
          programs: of the archive.
          robot: its index in the `robots` of the archive.
          positions: `[N, 2]` of the PoIs in the frame `map`, in metres.

        Raises:
          ValueError: if there is no such robot, two positions are the same, the policy is for
            another number of PoIs, or robots have maps of their own.
        """
        positions = np.asarray(positions, np.float32)
        if positions.ndim != 2 or positions.shape[1] != 2 or not np.isfinite(positions).all():
            raise ValueError(f"positions = {positions.tolist()}: must be two finite numbers each")
        if len(np.unique(positions, axis=0)) < len(positions):
            raise ValueError(f"positions = {positions.tolist()}: must differ from each other")
        number, pois, modalities = len(contents["robots"]), len(positions), contents["modalities"]
        if not isinstance(robot, int) or not 0 <= robot < number:
            raise ValueError(
                f"robot = {robot}: must be one of {dict(enumerate(contents['robots']))}"
            )
        expected = contents["programs"]["decide"]["inputs"]["positions"]["shape"][0]
        if expected not in ("pois", pois):
            anyway = "export pretrained:team or many for a policy for any number"
            raise ValueError(f"{pois} PoIs: the policy of this archive is for {expected}; {anyway}")
        if "merge" in programs:
            raise ValueError("robots have maps of their own: see `tell` in run_exported.py")
        self.contents, self.programs = contents, programs
        self.robot = robot
        self.name = contents["robots"][robot]
        self.mounting, self.is_upside_down = np.zeros(3), False
        self.target: int | None = None
        self.goal: np.ndarray | None = None
        self.team = {
            "positions": positions,
            "present": np.ones(pois, bool),
            "poses": np.zeros((number, 3), np.float32),
            "modality": np.array([modalities.index(name) for name in contents["robots"]]),
            "works": np.arange(number) == robot,
            "target": np.full(number, pois, np.int32),
        }
        self.known = empty(contents, pois)
        self.notes: list[str] = []
        self._has_news = True
        self._last_pose, self._last_stamp = np.full(3, np.inf), -np.inf
        self._heard_at = np.full(number, -np.inf)
        self._failed_at: list[list[np.ndarray]] = [[] for _ in range(pois)]

    @property
    def is_done(self) -> bool:
        """Whether it looks at nothing more."""
        return not self.team["works"][self.robot]

    def choose(self, now: float, pose: np.ndarray) -> None:
        """Sets target and goal by the policy, if the map is new since the last choice.

        Args:
          now: time, in seconds.
          pose: of the robot in the frame `map`.
        """
        self.team["poses"][self.robot] = pose
        is_silent = now - self._heard_at > SILENCE
        is_silent[self.robot] = False
        self.team["works"] &= ~is_silent
        if self.is_done or not self._has_news:
            return
        self._has_news, before = False, self.target
        known = {name: self.known[name] for name in ("mean", "std", "looked_from")}
        while True:
            chosen = int(self.programs["decide"](**known, **self.team, robot=self.robot)["action"])
            if chosen in (len(self.team["positions"]), -1):
                self.target, self.goal = None, None
                self.team["works"][self.robot] = False
                self.notes.append("done: no further look is worth its cost")
                break
            # Under way to the same PoI, it keeps its viewpoint.
            if chosen != before or self.goal is None:
                self.goal = self._viewpoint(chosen)
            if self.goal is not None:
                self.target = chosen
                break
            self.team["present"][chosen] = False
            self.notes.append(f"gives PoI {chosen} up: nowhere is left to look from")
        self.team["target"][self.robot] = self._heading()

    def see(self, now: float, scan: Scan) -> dict[str, Any] | None:
        """Looks at the target, if the robot stands still at its goal and the scan is recent.

        Args:
          now: time, in seconds.
          scan: what the sensor has read.

        Returns:
          The look by which it has updated the map, for `report`; None if there was none.

        Raises:
          ValueError: if the scan is too narrow, or its beams or pixels are too far apart to be
            resampled.
        """
        self._require_wide(scan.angles)
        self._require_dense(scan.angles)
        elapsed, moved = scan.stamp - self._last_stamp, np.abs(scan.pose - self._last_pose)
        self._last_pose, self._last_stamp = np.array(scan.pose), scan.stamp
        # Over a long time, a mean speed says little about that of now.
        is_still = elapsed > 0 and (moved <= STILL * min(elapsed, STILL_FOR)).all()
        if self.goal is None or not is_still or now - scan.stamp > MAX_AGE:
            return None
        sensor, limits = compose(scan.pose, self.mounting), self.contents["viewpoint"]
        away = self.team["positions"][self.target] - sensor[:2]
        distance, bearing = math.hypot(*away), wrapped(math.atan2(away[1], away[0]) - sensor[2])
        is_there = np.linalg.norm(scan.pose[:2] - self.goal[:2]) <= AT_GOAL
        is_there &= limits["min_distance"] <= distance <= limits["max_distance"]
        if not is_there or abs(bearing) > limits["max_bearing"]:
            return None
        found = self.programs[f"detect_{self.name}"](
            readings=self._along_own_rays(scan), bearing=bearing, distance=distance
        )
        where = f"PoI {self.target}, {distance:.2f} m away"
        if not found["is_known"]:
            self.notes.append(f"outside of what was recorded or learned: {where}")
        elif not found["detects"]:
            self.notes.append(f"nothing detected of {where}")
        if not found["detects"]:
            self.fail(scan.pose)
            return None
        look = {
            "poi": self.target,
            "features": found["features"].tolist(),
            "weight": self._weight(self.target, scan.pose),
            "place": scan.pose[:2].tolist(),
        }
        self.goal = None
        self._write(self.robot, look)
        return look

    def fail(self, pose: np.ndarray) -> None:
        """Gives up the viewpoint, and after `attempts` failures the PoI.

        Args:
          pose: of the robot, from which it did not detect the PoI or where it is stuck.
        """
        if self.target is None:
            return
        self.goal, self._has_news = None, True
        self._failed_at[self.target].append(pose[:2])
        failures, attempts = len(self._failed_at[self.target]), self.contents["mission"]["attempts"]
        self.notes.append(f"failure {failures} of {attempts} at PoI {self.target}")
        if failures >= attempts:
            self.team["present"][self.target] = False
            self.notes.append(f"gives PoI {self.target} up")

    def classes(self) -> list[dict[str, float]]:
        """Probability of each class, by PoI."""
        belief = {name: self.known[name] for name in ("mean", "std")}
        found = self.programs["classify"](**belief)["probabilities"]
        return [dict(zip(self.contents["classes"], each.tolist(), strict=True)) for each in found]

    def report(self, look: dict[str, Any] | None = None) -> str:
        """What the robot tells the others: its state, and a look that it has taken, once."""
        pose = self.team["poses"][self.robot].tolist()
        state = {"robot": self.robot, "pose": pose, "target": self._heading()}
        return json.dumps({**state, "works": not self.is_done, "look": look})

    def hear(self, now: float, report: str) -> None:
        """Takes in what a robot tells; its own report is ignored.

        Args:
          now: time, in seconds.
          report: see `report`.

        Raises:
          ValueError: if it is no report of a robot in the team; it then changes nothing.
        """
        pois = len(self.team["positions"])
        try:
            told = json.loads(report)
            robot = index("robot", told["robot"], len(self._heard_at))
            if robot == self.robot:
                return
            state = {
                "poses": finite("pose", told["pose"], (3,)),
                "target": index("target", told["target"], pois + 1),
                "works": {True: True, False: False}[told["works"]],
            }
            if (look := told["look"]) is not None:
                index("poi", look["poi"], pois)
                finite("place", look["place"], (2,))
                within("weight", finite("weight", look["weight"], ()))
                labels = self.contents["labels"][self.contents["robots"][robot]]
                within("features", finite("features", look["features"], (len(labels),)))
                self._write(robot, look)
        except (KeyError, TypeError, ValueError, RecursionError) as error:
            raise ValueError(f"no report of a robot in the team: {error!r}") from error
        self._heard_at[robot] = now
        for name, value in state.items():
            self.team[name][robot] = value

    def _heading(self) -> int:
        """The target, as `decide` reads it."""
        return len(self.team["positions"]) if self.target is None else self.target

    def _require_wide(self, angles: np.ndarray) -> None:
        """Raises `ValueError` if a scan does not cover what the detector reads around a PoI."""
        if len(angles) < 2:
            raise ValueError(f"scan of {len(angles)} beams: must have two or more")
        width, window = np.degrees(np.ptp(angles)), self.contents["sensors"][self.name]["window"]
        if width < np.degrees(window):
            expected = f"must be at least {np.degrees(window):.1f}"
            raise ValueError(f"field of view = {width:.1f} degrees: {expected}")

    def _require_dense(self, angles: np.ndarray) -> None:
        """Raises `ValueError` if beams or pixels are too far apart."""
        own = self.contents["sensors"][self.name]["angles"]
        step, own_step = (np.degrees(np.median(np.abs(np.diff(each)))) for each in (angles, own))
        if step > (most := resampling.MAX_STEPS * own_step):
            expected = f"must be at most {most:.2f}; train with the sensor's own"
            raise ValueError(f"step between beams = {step:.2f} degrees: {expected}")

    def _along_own_rays(self, scan: Scan) -> np.ndarray:
        """The scan along the rays that `detect` reads, without the gaps of single lost beams."""
        own = np.array(self.contents["sensors"][self.name]["angles"])
        measures_distance, readings = scan.readings.ndim == 1, scan.readings
        if measures_distance:
            step = resampling.median_step(own)
            readings = resampling.close_gaps(scan.angles, readings, step=step)
        return resampling.resample(
            own,
            -scan.angles if self.is_upside_down else scan.angles,
            readings,
            measures_distance=measures_distance,
        )

    def _weight(self, poi: int, pose: np.ndarray) -> float:
        """Share of a look from a pose that is new after the earlier ones by this sensor."""
        earlier = self.known["looked_from"][poi, self.team["modality"][self.robot]]
        apart = np.linalg.norm(earlier - pose[:2], axis=1)
        return float(self.programs[f"weigh_{self.name}"](apart=apart)["weight"])

    def _write(self, robot: int, look: dict[str, Any]) -> None:
        """Updates the map by a look of any robot."""
        name, m = self.contents["robots"][robot], self.team["modality"][robot]
        given = {key: np.asarray(look[key], np.float32) for key in ("features", "weight")}
        write(self.programs[f"write_{name}"], self.known, look["poi"], m, given)
        remember(self.contents, self.known, robot, look["poi"], m, np.array(look["place"]))
        self._has_news = True

    def _viewpoint(self, poi: int) -> np.ndarray | None:
        """The robot's nearest pose from which it has not failed and a look is new, if any."""
        positions, here = self.team["positions"], self.team["poses"][self.robot, :2]
        others = self.team["poses"][np.isfinite(self._heard_at), :2]
        failed = np.reshape(self._failed_at[poi], (-1, 2))
        avoided = np.concatenate([np.delete(positions, poi, axis=0), others, failed])
        found, shortest = None, np.inf
        for side in 2 * np.pi * np.arange(VIEW_SIDES) / VIEW_SIDES:
            away = VIEW_DISTANCE * np.array([np.cos(side), np.sin(side)])
            sensor = np.append(positions[poi] + away, wrapped(side + np.pi))
            pose = compose(sensor, inverse(self.mounting))
            way = np.linalg.norm(pose[:2] - here)
            is_free = (np.linalg.norm(avoided - pose[:2], axis=1) >= CLEARANCE).all()
            if way < shortest and is_free and self._weight(poi, pose) >= NEW:
                found, shortest = pose, way
        return found


def hear(node: Any, robot: Robot, now: float, report: str) -> None:
    """Lets a robot hear a message; warns once, with the reason, of those that are no reports."""
    try:
        robot.hear(now, report)
    except ValueError as error:
        node.get_logger().warning(f"ignored a message on `team`: {error}", once=True)


def log(node: Any, robot: Robot) -> None:
    """Logs a robot's notes, and empties them."""
    for note in robot.notes:
        node.get_logger().info(note)
    robot.notes.clear()


def join(node: Any, robot: Robot, now: Callable) -> Callable:
    """Lets a robot hear the others, and tells each second what it does and knows.

    Args:
      node: of `rclpy`.
      robot: what it plays.
      now: returns the time, in seconds.

    Returns:
      What tells the others of a look.
    """
    from std_msgs.msg import String

    team = node.create_publisher(String, "team", 100)
    classes = node.create_publisher(String, "classes", 1)

    def tell(look: dict[str, Any] | None = None) -> None:
        team.publish(String(data=robot.report(look)))
        classes.publish(String(data=json.dumps(robot.classes())))

    node.create_subscription(String, "team", lambda told: hear(node, robot, now(), told.data), 100)
    node.create_timer(1.0, tell)
    return tell


def connect(node: Any, robot: Robot) -> Any:
    """Connects a robot to topics and transforms.

    Args:
      node: of `rclpy`.
      robot: what it plays.

    Returns:
      What must live as long as the node.
    """
    from geometry_msgs.msg import PoseStamped
    from rclpy.duration import Duration
    from rclpy.qos import qos_profile_sensor_data
    from rclpy.time import Time
    from sensor_msgs.msg import CameraInfo, Image, LaserScan
    from tf2_ros import Buffer, TransformException, TransformListener

    buffer = Buffer()
    goals = node.create_publisher(PoseStamped, "goal_pose", 1)
    set_out_at, infos = 0.0, collections.deque(maxlen=1)

    def now() -> float:
        return node.get_clock().now().nanoseconds * 1e-9

    tell = join(node, robot, now)

    def transform(parent: str, child: str, when: Any) -> Any:
        return buffer.lookup_transform(parent, child, when, Duration(seconds=0.1)).transform

    def on_scan(scan: Any) -> None:
        on_reading(scan.header, lambda: beams(scan), is_optical=False)

    def on_image(image: Any) -> None:
        if infos:
            on_reading(image.header, lambda: scanline(image, infos[0]), is_optical=True)

    def on_reading(header: Any, read: Callable, is_optical: bool) -> None:
        nonlocal set_out_at
        stamp = Time.from_msg(header.stamp)
        try:
            pose, _ = pose_of(transform("map", "base_link", stamp))
            robot.mounting, robot.is_upside_down = pose_of(
                transform("base_link", header.frame_id, Time()), is_optical
            )
            look = robot.see(now(), Scan(stamp.nanoseconds * 1e-9, pose, *read()))
        except TransformException as error:
            node.get_logger().warning(f"no pose for a scan: {error}")
            return
        except ValueError as error:
            node.get_logger().error(f"ignores the scans: {error}", once=True)
            return
        if look is not None:
            tell(look)
        elif robot.goal is not None and now() - set_out_at > PATIENCE:
            robot.notes.append(f"has not looked within {PATIENCE:.0f} s")
            robot.fail(pose)
        before = robot.goal
        robot.choose(now(), pose)
        log(node, robot)
        if robot.goal is not None and robot.goal is not before:
            set_out_at = now()
            goal = PoseStamped()
            goal.header.frame_id, goal.header.stamp = "map", node.get_clock().now().to_msg()
            write_pose(goal.pose, robot.goal)
            goals.publish(goal)

    if robot.name == "camera":
        node.create_subscription(CameraInfo, "camera_info", infos.append, qos_profile_sensor_data)
        node.create_subscription(Image, "image", on_image, qos_profile_sensor_data)
    else:
        node.create_subscription(LaserScan, "scan", on_scan, qos_profile_sensor_data)
    return TransformListener(buffer, node, spin_thread=True)


def point(text: str) -> list[float]:
    """The numbers of `X,Y`, in metres."""
    try:
        x, y = map(float, text.split(","))
    except ValueError:
        expected = "must be two numbers X,Y in metres, without a space"
        raise argparse.ArgumentTypeError(f"{text!r}: {expected}") from None
    return [x, y]


def main() -> None:
    """Runs the node."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("archive", type=Path, help="file of `jaxsense export`")
    parser.add_argument("--robot", type=int, default=0, help="index of this robot in the run")
    parser.add_argument(
        "--pois",
        nargs="+",
        required=True,
        type=point,
        metavar="X,Y",
        help="positions of the PoIs, in metres",
    )
    own = itertools.takewhile(lambda each: each != "--ros-args", sys.argv[1:])
    # With a space before it, argparse takes -1.2,0.8 for no option.
    arguments = parser.parse_args(
        [f" {each}" if re.match(r"-\.?\d", each) else each for each in own]
    )
    try:
        robot = Robot(*load(arguments.archive), arguments.robot, np.array(arguments.pois))
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
