"""Reads the laser scans in logs of MRPT, the Mobile Robot Programming Toolkit, with NumPy alone.

Debian's package `mrpt-common` installs some under `/usr/share/mrpt/datasets`. A log is a stream of
objects, compressed by gzip: a flag, the name of a type, a version, little-endian fields, and the
flag of its end.
"""

import dataclasses
import gzip
import re
import struct
import zlib
from pathlib import Path

import numpy as np
from jaxtyping import Float

DIRECTORY = Path("/usr/share/mrpt/datasets")
"""Where Debian installs logs."""
LOGS = (
    "2006-01ENE-21-SENA_Telecom Faculty_one_loop_only.rawlog",
    "localization_demo.rawlog",
    "uwb_ro-localization_demo.rawlog",
    "malaga-cs-fac-building.simplemap.gz",
)
"""Those that hold scans of a real scanner, all of 361 beams over 180 degrees."""
_SCAN = re.compile(rb"\x97CObservation2DRangeScan(.)", re.DOTALL)
_VERSION = 6
_HEAD = struct.Struct("<f?f")  # field of view [rad], whether from right to left, maximum range [m]
_POSE = re.compile(rb"\x87CPose3D(.)", re.DOTALL)
_POSE_SIZES = {1: 147, 2: 56}  # bytes of the scanner's pose on the robot, by the version
_COUNT = struct.Struct("<I")


@dataclasses.dataclass(frozen=True)
class LaserScans:
    """Laser scans of a log: S scans of A beams by one scanner.

    Attributes:
      angles: `[A]` directions of the beams, in radians, from right to left.
      ranges: `[S, A]` distances, in metres, infinite without a return.
    """

    angles: Float[np.ndarray, " A"]
    ranges: Float[np.ndarray, "S A"]


def read(path: Path | str) -> LaserScans:
    """Reads all laser scans of an MRPT log.

    Args:
      path: a `.rawlog` or `.simplemap.gz`.

    Raises:
      OSError: if the file cannot be read.
      ValueError: if it holds no laser scans, one of another version, a damaged one, or scans of
        several scanners.
    """
    content = Path(path).read_bytes()
    try:
        while content.startswith(b"\x1f\x8b"):
            content = gzip.decompress(content)
    except (EOFError, zlib.error) as error:
        raise ValueError(f"{path} is not a complete gzip file: {error}") from None
    try:
        scans = [_scan(content, found) for found in _SCAN.finditer(content)]
    except (struct.error, ValueError) as error:
        raise ValueError(f"{path}: {error}") from None
    if not scans:
        raise ValueError(f"{path} holds no laser scans of MRPT")
    if len({(len(ranges), aperture) for aperture, ranges in scans}) > 1:
        raise ValueError(f"{path} holds scans of several scanners")
    half = scans[0][0] / 2
    angles = np.linspace(-half, half, len(scans[0][1]), dtype=np.float32)
    return LaserScans(angles, np.stack([ranges for _, ranges in scans]))


def read_logs(directory: Path = DIRECTORY) -> LaserScans:
    """Reads the scans of the MRPT logs that `LOGS` names, as one recording.

    Args:
      directory: where they are.

    Raises:
      OSError: if a log cannot be read.
      ValueError: if a log is not what it should be, see `read`.
    """
    logs = [read(directory / name) for name in LOGS]
    return LaserScans(logs[0].angles, np.concatenate([log.ranges for log in logs]))


def _scan(content: bytes, found: re.Match[bytes]) -> tuple[float, np.ndarray]:
    """Field of view of one scan, in radians, and its `[A]` ranges from right to left."""
    version = found[1][0]
    if version != _VERSION:
        raise ValueError(f"version of a laser scan = {version}: must be {_VERSION}")
    aperture, from_right, _ = _HEAD.unpack_from(content, found.end())
    pose = _POSE.match(content, found.end() + _HEAD.size)
    if pose is None or pose[1][0] not in _POSE_SIZES:
        raise ValueError("a laser scan is damaged, or the pose of its scanner has another version")
    start = pose.end() + _POSE_SIZES[pose[1][0]] + 1  # the end's flag
    (number,) = _COUNT.unpack_from(content, start)
    start += _COUNT.size
    if start + 5 * number > len(content):
        raise ValueError("a laser scan ends early")
    ranges = np.frombuffer(content, "<f4", number, start)
    is_valid = np.frombuffer(content, "u1", number, start + 4 * number) > 0
    measured = np.where(is_valid, ranges, np.inf).astype(np.float32)
    return aperture, measured if from_right else measured[::-1]
