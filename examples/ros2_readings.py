"""Messages of ROS 2 as numbers, by their fields alone, so that no ROS is needed to read them."""

import math
from typing import Any

import numpy as np
from run_exported import numbers, require

LEVEL = 0.95  # cosine of the largest tilt of a sensor

_CHANNELS = {"rgb8": [0, 1, 2], "rgba8": [0, 1, 2], "bgr8": [2, 1, 0], "bgra8": [2, 1, 0]}


def beams(scan: Any) -> tuple[np.ndarray, np.ndarray]:
    """Angles, in radians, and distances, in metres, of a `sensor_msgs/LaserScan`.

    Drivers write infinity, NaN, 0 or a distance out of range for a beam without a return; here it
    is infinite. Minus infinity, for something too near to be measured, stays.
    """
    ranges, (near, far) = np.asarray(scan.ranges, np.float32), (scan.range_min, scan.range_max)
    require(0 <= near < far, f"ranges from {near} to {far} m: must be ascending")
    angles = scan.angle_min + scan.angle_increment * np.arange(len(ranges))
    rest = abs(scan.angle_max - (angles[-1] if len(angles) else np.inf))
    expected = f"must end at angle_max = {scan.angle_max:.3f}"
    require(rest < 1.5 * abs(scan.angle_increment), f"{len(ranges)} ranges: {expected}")
    is_return = (ranges >= near) & (ranges <= far) | np.isneginf(ranges)
    return angles, np.where(is_return, ranges, np.inf)


def scanline(image: Any, info: Any) -> tuple[np.ndarray, np.ndarray]:
    """Angles, in radians, and linear RGB, from 0 to 1, of the row of a picture at the horizon.

    Args:
      image: a rectified `sensor_msgs/Image` of a level camera, with 8 bits for each channel.
      info: its `sensor_msgs/CameraInfo`, whose matrix P belongs to rectified images.
    """
    known, size = ", ".join(_CHANNELS), (image.width, image.height)
    require(image.encoding in _CHANNELS, f"encoding = {image.encoding}: must be one of {known}")
    focal_length, middle, row = numbers("P of camera_info", info.p, (12,))[[0, 2, 6]]
    require(focal_length > 0, f"P[0] of camera_info = {focal_length}: must be above 0; calibrate")
    found = info.width, info.height
    require(found == size, f"camera_info is of {found} pixels: must be of {size}")
    row, channels = round(float(row)), len(image.encoding.removesuffix("8"))
    require(0 <= row < image.height, f"P[6] of camera_info = {row}: must be a row of the image")
    is_whole = len(image.data) >= image.height * image.step and image.step >= size[0] * channels
    require(is_whole, f"data of {len(image.data)} bytes in rows of {image.step}: must be of {size}")
    line = np.frombuffer(bytes(image.data), np.uint8)[row * image.step :][: image.width * channels]
    value = line.reshape(-1, channels)[:, _CHANNELS[image.encoding]] / 255
    # The inverse of sRGB's gamma.
    linear = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    return np.arctan2(middle - np.arange(image.width), focal_length), linear.astype(np.float32)


def pose_of(transform: Any, is_optical: bool = False) -> tuple[np.ndarray, bool]:
    """x, y and yaw of a `geometry_msgs/Transform` in the plane, and whether it is upside down.

    An optical frame looks along z, with x to the right; others along x, with y to the left.
    """
    q, place = transform.rotation, transform.translation
    ahead, left, up = (
        (2 * (q.x * q.z + q.y * q.w), 2 * (q.y * q.z - q.x * q.w), -2 * (q.y * q.z + q.x * q.w))
        if is_optical
        else (1 - 2 * (q.y**2 + q.z**2), 2 * (q.x * q.y + q.z * q.w), 1 - 2 * (q.x**2 + q.y**2))
    )
    kind = "z ahead, as an optical frame" if is_optical else "x ahead"
    require(abs(up) >= LEVEL, f"a frame is not level: must have {kind}")
    return np.array([place.x, place.y, math.atan2(left, ahead)]), up < 0


def wrapped(angle: float) -> float:
    """An angle in radians, from -pi to pi."""
    return (angle + math.pi) % (2 * math.pi) - math.pi


def turned(place: np.ndarray, yaw: float) -> np.ndarray:
    """A place in a frame of this yaw, along the axes of its parent."""
    sine, cosine = math.sin(yaw), math.cos(yaw)
    return np.array([[cosine, -sine], [sine, cosine]]) @ place
