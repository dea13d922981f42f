"""The arena, the sensors in it, and where a robot looks from."""

import dataclasses
import math
from typing import Literal

from jaxsense.config.checks import require, require_not_negative, require_positive, require_window

COLOURS: dict[str, tuple[float, float, float]] = {
    "red": (0.8, 0.1, 0.1),
    "green": (0.1, 0.7, 0.1),
    "blue": (0.1, 0.2, 0.8),
    "yellow": (0.8, 0.7, 0.1),
}
"""Albedo of each colour name that a PoI class can have, linear RGB in [0, 1]."""

ROBOT_RADIUS = 0.0495
"""Radius of an AMiRo, in metres."""

SHAPES: tuple[str, ...] = ("cylinder", "cube")
"""Shapes that a PoI class can have; the index is the shape code of `sim.arena.Layout`."""

MODALITIES: dict[str, Literal["colour", "shape"]] = {"camera": "colour", "lidar": "shape"}
"""The sensors that `sim` knows, and the attribute of a PoI that each one tells apart."""


@dataclasses.dataclass(frozen=True)
class ArenaConfig:
    """The square arena, its points of interest (PoIs) and the classes they are drawn from."""

    side: float = 3.0
    """Inner length and width of the arena, in metres."""
    num_pois: int = 3
    """Number of points of interest."""
    poi_radius: float = 0.1
    """Radius of a cylinder and half the side of a cube, in metres."""
    poi_height: float = 0.2
    """Height of a PoI, in metres; more than 0.152, or the LiDAR looks over it."""
    poi_gap: float = 0.3
    """Smallest free gap between two PoIs, in metres; a robot needs 0.1 to pass."""
    classes: tuple[str, ...] = ("green cylinder", "red cylinder", "red cube")
    """Classes of PoIs, each `"COLOUR SHAPE"`, drawn with equal chance."""

    def __post_init__(self):
        require_positive(self, "side", "num_pois", "poi_radius", "poi_height", "poi_gap")
        require(self.poi_height > 0.152, self, "poi_height", "must be more than 0.152 m")
        require(len(self.classes) > 0, self, "classes", 'must name a class, "COLOUR SHAPE"')
        for name in self.classes:
            colour, _, shape = name.partition(" ")
            require(
                colour in COLOURS and shape in SHAPES,
                self,
                "classes",
                f'{name!r} must be "COLOUR SHAPE" with a colour of {", ".join(COLOURS)} '
                f"and a shape of {', '.join(SHAPES)}",
            )
        require(
            len(set(self.classes)) == len(self.classes), self, "classes", "must name no class twice"
        )
        most = math.floor(self.side / self.poi_pitch) ** 2
        require(
            self.num_pois <= most,
            self,
            "num_pois",
            f"at most {most} PoIs of radius {self.poi_radius} m with gaps of {self.poi_gap} m "
            f"fit an arena of side {self.side} m",
        )

    @property
    def poi_extent(self) -> float:
        """Radius of the circle that holds a PoI of any shape at any yaw, in metres."""
        return math.sqrt(2.0) * self.poi_radius

    @property
    def poi_pitch(self) -> float:
        """Distance of two PoIs' centres that leaves the gap between them free, in metres."""
        return 2.0 * self.poi_extent + self.poi_gap

    def labels(self, attribute: Literal["colour", "shape"]) -> tuple[str, ...]:
        """The distinct colours or shapes of the classes, in order of first appearance.

        Green and red come as ("red", "green"), round and edgy as ("cylinder", "cube"): the order of
        the paper's feature vectors, which is the order of `COLOURS` and `SHAPES`.
        """
        known = COLOURS if attribute == "colour" else SHAPES
        used = {name.split(" ")[0 if attribute == "colour" else 1] for name in self.classes}
        return tuple(label for label in known if label in used)

    def label_of_class(self, attribute: Literal["colour", "shape"]) -> tuple[int, ...]:
        """For each class, the index of its colour or shape in `labels(attribute)`."""
        labels = self.labels(attribute)
        position = 0 if attribute == "colour" else 1
        return tuple(labels.index(name.split(" ")[position]) for name in self.classes)


@dataclasses.dataclass(frozen=True)
class LidarConfig:
    """The Hokuyo URG-04LX on the AMiRo."""

    num_beams: int = 683
    """Beams of one scan."""
    field_of_view: float = 240.0
    """Angle between the first and the last beam, in degrees."""
    min_range: float = 0.08
    """Shortest distance that is measured, in metres."""
    max_range: float = 5.0
    """Longest distance that is measured, in metres; also what a beam without a return reads."""
    range_noise: float = 0.01
    """Standard deviation of a distance, in metres."""
    window: int = 128
    """Beams around the PoI's bearing that the detector reads."""
    stride: int = 1
    """From each beam that the detector reads to the next, in beams."""
    window_range: float = 1.5
    """Longest distance that the detector is shown, in metres: what is behind a PoI is cut off."""

    def __post_init__(self):
        require_positive(
            self, "num_beams", "field_of_view", "min_range", "max_range", "window_range"
        )
        require_not_negative(self, "range_noise")
        require(self.field_of_view <= 360.0, self, "field_of_view", "must be at most 360 degrees")
        require(self.max_range > self.min_range, self, "max_range", "must be above min_range")
        require(self.window_range > self.min_range, self, "window_range", "must be above min_range")
        require_window(self, self.num_beams)


@dataclasses.dataclass(frozen=True)
class CameraConfig:
    """The camera on the AMiRo, of which one line of pixels is used."""

    num_pixels: int = 640
    """Pixels of the scanline."""
    field_of_view: float = 80.0
    """Horizontal field of view, in degrees."""
    pixel_noise: float = 0.007
    """Standard deviation of a pixel's value, where 1 is full scale."""
    window: int = 80
    """Pixels around the PoI's bearing that the detector reads."""
    stride: int = 4
    """From each pixel that the detector reads to the next, in pixels."""

    def __post_init__(self):
        require_positive(self, "num_pixels", "field_of_view")
        require_not_negative(self, "pixel_noise")
        require(self.field_of_view < 180.0, self, "field_of_view", "must be below 180 degrees")
        require_window(self, self.num_pixels)


@dataclasses.dataclass(frozen=True)
class ViewpointConfig:
    """Where a robot stands when it looks at a PoI."""

    min_distance: float = 0.3
    """Shortest distance from the sensor to the PoI's centre, in metres."""
    max_distance: float = 1.2
    """Longest distance from the sensor to the PoI's centre, in metres."""
    max_bearing: float = 20.0
    """Largest angle between the robot's heading and the PoI, to either side, in degrees."""
    bearing_error: float = 1.0
    """Largest error of the bearing at which the detector's window is centred, in degrees."""
    clearance: float = 0.03
    """Free space around the robot at a viewpoint, in metres."""

    def __post_init__(self):
        require_positive(self, "min_distance", "max_distance")
        require_not_negative(self, "max_bearing", "bearing_error", "clearance")
        require(self.max_bearing <= 30, self, "max_bearing", "must be at most 30 degrees")
        require(self.bearing_error <= 10, self, "bearing_error", "must be at most 10 degrees")
        require(
            self.max_distance > self.min_distance,
            self,
            "max_distance",
            "must be above min_distance",
        )
