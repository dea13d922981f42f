"""What the node for ROS 2 reads from messages and writes to them, without ROS."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from ros2_messages import CameraInfo, Image, LaserScan, Transform, at, quaternion


def test_beams_without_a_return_are_infinite(ros2):
    ranges = [0.0, 0.05, 0.1, 1.0, 5.0, 5.1, math.inf, math.nan, -math.inf]
    angles, distances = ros2.beams(LaserScan(-0.4, 0.1, ranges))
    none = math.inf
    expected = np.float32([none, none, 0.1, 1.0, 5.0, none, none, none, -none])
    np.testing.assert_array_equal(distances, expected)
    np.testing.assert_allclose(angles, np.arange(-4, 5) / 10, atol=1e-12)


@pytest.mark.parametrize(
    ("encoding", "of_pixel"), [("rgb8", [0, 188, 255]), ("bgra8", [255, 188, 0, 7])]
)
def test_the_row_at_the_horizon_is_linear_rgb(ros2, encoding, of_pixel):
    width, padding = 5, 3
    row = bytes(of_pixel) * width + b"\1" * padding
    picture = Image(encoding, width, len(row), b"\0" * len(row) + row + b"\2" * len(row))
    info = CameraInfo([4.0, 0, 2.0, 0, 0, 4.0, 1.1, 0, 0, 0, 1, 0], width, 3)
    angles, values = ros2.scanline(picture, info)
    # sRGB: ((188 / 255 + 0.055) / 1.055)^2.4 = 0.503.
    np.testing.assert_allclose(values, [[0, 0.503, 1]] * width, atol=1e-3)
    np.testing.assert_allclose(np.tan(angles), [0.5, 0.25, 0, -0.25, -0.5], atol=1e-12)


def test_an_unknown_encoding_is_named(ros2):
    with pytest.raises(ValueError, match=r"encoding = 'mono8': must be one of rgb8, "):
        ros2.scanline(Image("mono8", 1, 1, b"\0"), CameraInfo([1.0] * 12, 1, 1))


@pytest.mark.parametrize(
    ("info", "expected"),
    [
        (CameraInfo([0.0] * 12, 2, 2), r"P\[0\] of camera_info = 0.0: must be above 0"),
        (CameraInfo([], 2, 2), r"P of camera_info = \[\]: must be finite numbers of a 3 x 4"),
        (CameraInfo([math.nan] * 12, 2, 2), r"P of camera_info = .*: must be finite numbers"),
        (CameraInfo([4.0, 0, 1, 0, 0, 4, 1, 0], 4, 2), "is of 4 x 2 pixels: must be 2 x 2"),
        (
            CameraInfo([4.0, 0, 1, 0, 0, 4, 2.6, 0], 2, 2),
            r"P\[6\] .* = 3: must be a row from 0",
        ),
    ],
)
def test_a_calibration_that_does_not_fit_is_named(ros2, info, expected):
    with pytest.raises(ValueError, match=expected):
        ros2.scanline(Image("rgb8", 2, 6, b"\0" * 12), info)


@pytest.mark.parametrize(
    ("encoding", "step", "size"), [("rgb8", 6, 11), ("rgb8", 5, 10), ("rgba8", 6, 12)]
)
def test_a_picture_that_is_not_whole_is_refused(ros2, encoding, step, size):
    info = CameraInfo([4.0, 0, 1, 0, 0, 4, 1, 0], 2, 2)
    expected = f"data of {size} bytes in rows of {step}: must be 2 rows of"
    image = SimpleNamespace(encoding=encoding, width=2, height=2, step=step, data=b"\0" * size)
    with pytest.raises(ValueError, match=expected):
        ros2.scanline(image, info)


ROOT = math.sqrt(0.5)


@pytest.mark.parametrize(
    ("rotation", "is_optical", "yaw", "is_upside_down"),
    [
        ((0, 0, ROOT, ROOT), False, math.pi / 2, False),
        ((1, 0, 0, 0), False, 0.0, True),  # rolled by half a turn
        ((0, 1, 0, 0), False, math.pi, True),  # pitched by half a turn
        ((-0.5, 0.5, -0.5, 0.5), True, 0.0, False),  # an optical frame that looks ahead
        ((0.5, 0.5, 0.5, 0.5), True, 0.0, True),
        ((-ROOT, 0, 0, ROOT), True, math.pi / 2, False),
    ],
)
def test_poses_of_frames(ros2, rotation, is_optical, yaw, is_upside_down):
    pose, hangs = ros2.pose_of(Transform(at(1, 2), quaternion(*rotation)), is_optical)
    np.testing.assert_allclose(pose, [1, 2, yaw], atol=1e-9)
    assert hangs == is_upside_down


@pytest.mark.parametrize(("is_optical", "kind"), [(True, "z ahead, as an opt"), (False, "x ahead")])
def test_a_frame_that_looks_up_is_refused(ros2, is_optical, kind):
    # No turn: the x axis lies ahead, and z points up. Pitched by a quarter turn, x points down.
    rotation = (0, 0, 0, 1) if is_optical else (0, ROOT, 0, ROOT)
    with pytest.raises(ValueError, match=f"the frame looks up or down: must have {kind}"):
        ros2.pose_of(Transform(at(0, 0), quaternion(*rotation)), is_optical)


@pytest.mark.parametrize("yaw", [-2.5, 0.0, 1.0, 3.1])
def test_a_goal_is_written_as_it_is_read(ros2, yaw):
    message = SimpleNamespace(position=at(0, 0), orientation=quaternion(0.0, 0.0, 0.0, 1.0))
    ros2.write_pose(message, np.array([1.5, -2.0, yaw]))
    found, _ = ros2.pose_of(Transform(message.position, message.orientation))
    np.testing.assert_allclose(found, [1.5, -2.0, yaw])


def test_poses_are_composed(ros2):
    # A quarter turn to the left: ahead is +y, left is -x.
    found = ros2.compose(np.array([1, 2, math.pi / 2]), np.array([0.5, 0.25, math.pi]))
    np.testing.assert_allclose(found, [0.75, 2.5, -math.pi / 2])
    back = ros2.compose(found, ros2.inverse(np.array([0.5, 0.25, math.pi])))
    np.testing.assert_allclose(back, [1, 2, math.pi / 2], atol=1e-12)
