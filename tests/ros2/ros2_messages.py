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

    @property
    def height(self):
        return len(self.data) // self.step


@dataclass
class CameraInfo:
    p: list
    width: int
    height: int


@dataclass
class Transform:
    translation: SimpleNamespace
    rotation: SimpleNamespace = field(default_factory=lambda: quaternion(0, 0, 0, 1))


def quaternion(x, y, z, w):
    return SimpleNamespace(x=x, y=y, z=z, w=w)


def at(x, y):
    return SimpleNamespace(x=x, y=y, z=0.2)
