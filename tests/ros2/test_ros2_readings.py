"""What the node for ROS 2 reads from messages, without ROS."""

import math
from types import SimpleNamespace

import numpy as np
import pytest


def quaternion(x, y, z, w):
    return SimpleNamespace(x=x, y=y, z=z, w=w)


def scan_of(ranges, **changes):
    end = 0.1 * (len(ranges) - 1) - 0.4
    fields = {"angle_min": -0.4, "angle_max": end, "angle_increment": 0.1}
    fields |= {"range_min": 0.1, "range_max": 5.0}
    return SimpleNamespace(ranges=ranges, **{**fields, **changes})


def test_beams_without_a_return_are_infinite(ros2):
    ranges = [0.0, 0.05, 0.1, 1.0, 5.0, 5.1, math.inf, math.nan, -math.inf]
    angles, distances = ros2.beams(scan_of(ranges))
    none = math.inf
    expected = np.float32([none, none, 0.1, 1.0, 5.0, none, none, none, -none])
    np.testing.assert_array_equal(distances, expected)
    np.testing.assert_allclose(angles, np.arange(-4, 5) / 10, atol=1e-12)
    # Some drivers end one step later.
    assert len(ros2.beams(scan_of([1.0] * 9, angle_max=0.5))[0]) == 9


P = [4.0, 0, 2.0, 0, 0, 4.0, 1.1, 0, 0, 0, 1, 0]


def picture(encoding="rgb8", width=5, height=3, row=bytes(15), step=None):
    fields = {"encoding": encoding, "width": width, "height": height}
    rows = b"\0" * len(row) + row + b"\2" * len(row)
    return SimpleNamespace(step=len(row) if step is None else step, data=rows, **fields)


def info_of(p=P, width=5, height=3):
    return SimpleNamespace(p=p, width=width, height=height)


@pytest.mark.parametrize(
    ("encoding", "of_pixel"), [("rgb8", [0, 188, 255]), ("bgra8", [255, 188, 0, 7])]
)
def test_the_row_at_the_horizon_is_linear_rgb(ros2, encoding, of_pixel):
    row = bytes(of_pixel) * 5 + b"\1" * 3  # and padding
    angles, values = ros2.scanline(picture(encoding, row=row), info_of())
    # sRGB: ((188 / 255 + 0.055) / 1.055)^2.4 = 0.503.
    np.testing.assert_allclose(values, [[0, 0.503, 1]] * 5, atol=1e-3)
    np.testing.assert_allclose(np.tan(angles), [0.5, 0.25, 0, -0.25, -0.5], atol=1e-7)


@pytest.mark.parametrize(
    ("image", "info", "expected"),
    [
        (picture("mono8"), info_of(), "encoding = mono8: must be one of rgb8, "),
        (picture(), info_of([0.0] * 12), r"P\[0\] of camera_info = 0.0: must be above 0"),
        (picture(), info_of([]), r"P of camera_info = \[\]: must be finite numbers of shape"),
        (picture(), info_of([math.nan] * 12), "P of camera_info = .*: must be finite numbers"),
        (picture(), info_of(width=4), r"is of \(4, 3\) pixels: must be of \(5, 3\)"),
        (picture(), info_of([*P[:6], 2.6, *P[7:]]), r"P\[6\] of camera_info = 3: must be a row"),
        (picture(row=bytes(14)), info_of(), "data of 42 bytes in rows of 14: must be of"),
        (picture(step=16), info_of(), "data of 45 bytes in rows of 16"),
        (picture("rgba8"), info_of(), "data of 45 bytes in rows of 15"),
    ],
)
def test_pictures_and_calibrations_that_do_not_fit_are_named(ros2, image, info, expected):
    with pytest.raises(ValueError, match=expected):
        ros2.scanline(image, info)


ROOT = math.sqrt(0.5)
TILTED = math.sin(0.25), math.cos(0.25)  # of half of 0.5 rad


def transform(rotation):
    place = SimpleNamespace(x=1, y=2, z=0.2)
    return SimpleNamespace(translation=place, rotation=quaternion(*rotation))


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
    pose, hangs = ros2.pose_of(transform(rotation), is_optical)
    np.testing.assert_allclose(pose, [1, 2, yaw], atol=1e-9)
    assert hangs == is_upside_down


@pytest.mark.parametrize(
    ("rotation", "is_optical"),
    [
        ((0, 0, 0, 1), True),  # z points up
        ((0, ROOT, 0, ROOT), False),  # pitched by a quarter turn, x points down
        ((ROOT, 0, 0, ROOT), False),  # rolled by a quarter turn, upright
        ((0, TILTED[0], 0, TILTED[1]), False),
    ],
)
def test_a_frame_that_is_not_level_is_refused(ros2, rotation, is_optical):
    with pytest.raises(ValueError, match=r"a frame is not level: must have [xz] ahead"):
        ros2.pose_of(transform(rotation), is_optical)
