"""Messages of ROS, by the fields that the node reads."""

from dataclasses import dataclass, field
from types import SimpleNamespace


@dataclass
class LaserScan:
    angle_min: float
    angle_increment: float
    ranges: list
    range_min: float = 0.1
    range_max: float = 5.0


@dataclass
class Image:
    encoding: str
    width: int
    step: int
    data: bytes


@dataclass
class CameraInfo:
    k: list


@dataclass
class Transform:
    translation: SimpleNamespace
    rotation: SimpleNamespace = field(default_factory=lambda: quaternion(0, 0, 0, 1))


def quaternion(x, y, z, w):
    return SimpleNamespace(x=x, y=y, z=z, w=w)


def at(x, y):
    return SimpleNamespace(x=x, y=y, z=0.2)
