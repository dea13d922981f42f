"""Settings of the arena, the sensors in it, and viewpoints."""

import dataclasses
import math
from typing import Any

from jaxsense.config.checks import (
    ConfigError,
    require,
    require_at_most,
    require_not_negative,
    require_positive,
    require_types,
    require_window,
)
from jaxsense.config.objects import COLOURS, SHAPES, Attribute, Shape, require_words
from jaxsense.config.section import Traced, section

ROBOT_RADIUS = 0.0495
"""Radius of an AMiRo, in metres."""

LIDAR_HEIGHT = 0.152
"""Height of an AMiRo's laser beams above the floor, in metres."""

TIMESTEP = 0.01
"""Step of the physics, in seconds."""

MODALITIES: dict[str, str] = {"camera": "colour", "lidar": "shape"}
"""Built-in sensors, and the attribute of a PoI that each distinguishes."""


@section
class ArenaConfig:
    """The square arena, its points of interest (PoIs) and the classes they are drawn from."""

    side: float = 3.0
    """Inner length and width of the arena, in metres."""
    num_pois: int = 3
    """Number of points of interest."""
    poi_radius: float = 0.1
    """Radius of a cylinder and half the side of a cube, in metres; unit of custom shapes."""
    poi_height: float = 0.2
    """Height of a PoI, in metres; more than 0.152, or the LiDAR looks over it."""
    poi_gap: float = 0.3
    """Smallest gap between two PoIs, in metres; a robot needs 0.1 to pass."""
    classes: tuple[str, ...] = ("green cylinder", "red cylinder", "red cube")
    """Equally likely classes of PoIs, each `"COLOUR SHAPE"` and a word for each of `attributes`."""
    colours: dict[str, tuple[float, float, float]] = dataclasses.field(
        default_factory=COLOURS.copy, hash=False
    )
    """Albedo of each colour, linear RGB in [0, 1]."""
    shapes: dict[str, Shape] = dataclasses.field(default_factory=SHAPES.copy, hash=False)
    """Solid of each shape. Every PoI carries all of them, and rays are cast at each."""
    attributes: dict[str, Attribute] = dataclasses.field(default_factory=dict, hash=False)
    """Attributes besides colour and shape, for custom sensors."""

    def check(self) -> None:
        """Raises `ConfigError` for an invalid field."""
        require_types(self)
        require_positive(self, "side", "num_pois", "poi_radius", "poi_height", "poi_gap")
        require_at_most(self, side=100, num_pois=64, poi_height=10)
        reason = f"must be more than {LIDAR_HEIGHT} m"
        require(self.poi_height > LIDAR_HEIGHT, self, "poi_height", reason)
        require_words(self.colours, "arena.colours")
        require_words(self.shapes, "arena.shapes")
        for name, rgb in self.colours.items():
            if not all(0 <= part <= 1 for part in rgb):
                field = f"arena.colours.{name}"
                raise ConfigError(field, rgb, "must be red, green and blue, each within 0 and 1")
        if self.attributes:
            require_words(self.attributes, "arena.attributes")
        for name in ("colour", "shape"):
            if name in self.attributes:
                raise ConfigError("arena.attributes", name, "is there already; must be a new name")
        self._check_classes()
        most = math.floor(self.side / self.poi_pitch) ** 2
        require(
            self.num_pois <= most,
            self,
            "num_pois",
            f"at most {most} PoIs of radius {self.poi_radius} m with gaps of {self.poi_gap} m "
            f"fit an arena of side {self.side} m",
        )

    def _check_classes(self) -> None:
        form = " ".join(name.upper() for name in self._words)
        require(len(self.classes) > 0, self, "classes", f'must name a class, "{form}"')
        kinds = " and ".join(f"a {n} of {', '.join(known)}" for n, known in self._words.items())
        for name in self.classes:
            words = name.split(" ")
            require(
                len(words) == len(self._words)
                and all(w in known for w, known in zip(words, self._words.values(), strict=True)),
                self,
                "classes",
                f'{name!r} must be "{form}" with {kinds}',
            )
        require(
            len(set(self.classes)) == len(self.classes), self, "classes", "must name no class twice"
        )
        for name in self._words:
            of_words: dict[Any, str] = {}
            for word in self.labels(name):
                what = self._words[name][word]
                # A PoI may have any yaw.
                look = (what.primitive, *sorted(what.half_sides)) if name == "shape" else what
                twin = of_words.setdefault(look, word)
                reason = f"must not use both {twin!r} and {word!r}, which no sensor can distinguish"
                require(twin == word, self, "classes", reason)

    @property
    def poi_extent(self) -> float:
        """Radius of the circle that holds a PoI of any shape at any yaw, in metres."""
        return math.sqrt(2.0) * self.poi_radius

    @property
    def poi_pitch(self) -> float:
        """Smallest distance of two PoIs' centres that keeps the gap, in metres."""
        return 2.0 * self.poi_extent + self.poi_gap

    @property
    def poi_half_width(self) -> float:
        """Half the smallest width of a PoI of any class from any side, in metres."""
        used = [self.shapes[shape] for shape in self.labels("shape")]
        return min(min(shape.half_sides) for shape in used) * self.poi_radius

    @property
    def _words(self) -> dict[str, dict[str, Any]]:
        """For each word of a class, its attribute and the possible values."""
        own = {name: attribute.values for name, attribute in self.attributes.items()}
        return {"colour": self.colours, "shape": self.shapes, **own}

    def values(self, attribute: str) -> tuple[Any, ...]:
        """For each class, the value of its word: RGB, a `Shape`, or a number."""
        known = self._words[attribute]
        return tuple(known[word] for word in self._words_of_classes(attribute))

    def labels(self, attribute: str) -> tuple[str, ...]:
        """Distinct colours, shapes or other words of the classes, in order of declaration.

        By default ("red", "green") and ("cylinder", "cube"): the order of `colours` and `shapes`,
        and of the paper's feature vectors.
        """
        used = self._words_of_classes(attribute)
        return tuple(label for label in self._words[attribute] if label in used)

    def label_of_class(self, attribute: str) -> tuple[int, ...]:
        """For each class, the index of its colour, shape or other word in `labels(attribute)`."""
        labels = self.labels(attribute)
        return tuple(labels.index(word) for word in self._words_of_classes(attribute))

    def _words_of_classes(self, attribute: str) -> list[str]:
        position = list(self._words).index(attribute)
        return [name.split(" ")[position] for name in self.classes]


@section
class LidarConfig:
    """The Hokuyo URG-04LX on the AMiRo."""

    num_beams: int = 683
    """Beams per scan."""
    field_of_view: float = 240.0
    """Angle between the first and the last beam, in degrees."""
    min_range: Traced[float] = 0.08
    """Shortest measured distance, in metres."""
    max_range: Traced[float] = 5.0
    """Longest measured distance, in metres; also the reading of a beam without a return."""
    range_noise: Traced[float] = 0.01
    """Standard deviation of a measured distance, in metres; see `range_noise_growth`."""
    range_noise_growth: float = 0.0
    """Growth of that standard deviation with the distance, in metres per metre."""
    mixed_pixels: float = 0.0
    """Probability that a beam also meets the surface that the next beam meets, and measures a
    distance between the two: at edges, one where nothing is."""
    dropout: float = 0.0
    """Probability that a beam has no return."""
    window: int = 128
    """Beams around the PoI's bearing that the detector reads."""
    stride: int = 1
    """Step between the beams that the detector reads, in beams."""
    window_range: Traced[float] = 1.5
    """Longest distance in the detector's input, in metres: cuts off the background."""

    def check(self) -> None:
        """Raises `ConfigError` for an invalid field."""
        require_types(self)
        require_positive(
            self, "num_beams", "field_of_view", "min_range", "max_range", "window_range"
        )
        require_not_negative(self, "range_noise", "range_noise_growth", "mixed_pixels", "dropout")
        require_at_most(self, num_beams=100_000, max_range=1000, range_noise=self.max_range)
        require_at_most(self, range_noise_growth=1, mixed_pixels=1, dropout=1)
        require(self.field_of_view <= 360.0, self, "field_of_view", "must be at most 360 degrees")
        require(self.max_range > self.min_range, self, "max_range", "must be above min_range")
        require(self.window_range > self.min_range, self, "window_range", "must be above min_range")
        require_window(self, self.num_beams)


@section
class CameraConfig:
    """One line of pixels of the camera on the AMiRo."""

    num_pixels: int = 640
    """Pixels of the scanline."""
    field_of_view: float = 80.0
    """Horizontal field of view, in degrees."""
    pixel_noise: Traced[float] = 0.007
    """Standard deviation of a pixel's value, where 1 is full scale."""
    exposure_error: float = 0.0
    """Standard deviation of the natural logarithm of an image's brightness."""
    colour_cast: float = 0.0
    """Standard deviation of the natural logarithm of each channel's brightness in an image."""
    low_light: float = 0.0
    """Largest share of the light that may be missing in an image, within 0 and 1; the share is
    uniform."""
    shadow: float = 0.0
    """Probability that a shadow falls into the view. One of its sides has ambient light only, from
    a random pixel on."""
    window: int = 80
    """Pixels around the PoI's bearing that the detector reads."""
    stride: int = 4
    """Step between the pixels that the detector reads, in pixels."""

    def check(self) -> None:
        """Raises `ConfigError` for an invalid field."""
        require_types(self)
        require_positive(self, "num_pixels", "field_of_view")
        require_not_negative(self, "pixel_noise", "exposure_error", "colour_cast")
        require_not_negative(self, "low_light", "shadow")
        require_at_most(self, num_pixels=100_000, pixel_noise=1, exposure_error=10, colour_cast=10)
        require_at_most(self, low_light=1, shadow=1)
        require(self.field_of_view < 180.0, self, "field_of_view", "must be below 180 degrees")
        require_window(self, self.num_pixels)


@section
class ViewpointConfig:
    """Viewpoints from which a robot looks at a PoI."""

    min_distance: Traced[float] = 0.3
    """Shortest distance from the sensor to the PoI's centre, in metres."""
    max_distance: Traced[float] = 1.2
    """Longest distance from the sensor to the PoI's centre, in metres."""
    max_bearing: Traced[float] = 20.0
    """Largest angle between the robot's heading and the PoI, to either side, in degrees."""
    bearing_error: Traced[float] = 1.0
    """Largest error of the bearing on which the detector's window is centred, in degrees."""
    clearance: Traced[float] = 0.03
    """Free space around the robot at a viewpoint, in metres."""

    def check(self) -> None:
        """Raises `ConfigError` for an invalid field."""
        require_types(self)
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


@dataclasses.dataclass(frozen=True)
class SensorConfig:
    """A custom sensor, carried like a camera or a LiDAR."""

    make: str
    """Function of `Config` that makes the `sim.Sensor`, as `package.module:function`; a name, for
    runs to store."""
    attribute: str
    """Attribute that it distinguishes: `colour`, `shape` or one of `arena.attributes`."""

    def __post_init__(self):
        require_types(self)
        module, _, function = self.make.partition(":")
        is_name = function.isidentifier() and all(p.isidentifier() for p in module.split("."))
        require(is_name, self, "make", "must be package.module:function")
