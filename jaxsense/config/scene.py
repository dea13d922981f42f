"""Settings of the arena, of what stands in it, of sensors, and of viewpoints."""

import math
import re
from collections.abc import Mapping
from typing import Literal

from jaxsense.config.section import (
    Checked,
    ConfigError,
    FrozenDict,
    Section,
    Traced,
    is_function_name,
    limited,
    require,
)

_MIN_SHARE = 0.5  # sensors may miss a narrower shape that they face
_MAX_NAME = 64  # letters; it becomes part of the names of files

ROBOT_RADIUS = 0.0495
"""Radius of an AMiRo, in metres."""

LIDAR_HEIGHT = 0.152
"""Height of an AMiRo's laser beams above the floor, in metres."""

POI_HEIGHT = 0.2
"""Height of a PoI, in metres; beams and cameras must not look over it."""

WALL_HEIGHT, WALL_THICKNESS = 0.3, 0.05
"""Height and thickness of walls, in metres."""

MAX_BEARING = 20.0
"""Largest angle between a robot's heading and the PoI that it looks at, to either side, in
degrees."""

CLEARANCE = 0.03
"""Minimum free space around a robot at a viewpoint, in metres."""

TIMESTEP = 0.01
"""Step of the physics, in seconds."""

MODALITIES: Mapping[str, str] = FrozenDict({"camera": "colour", "lidar": "shape"})
"""Built-in sensors, and the attribute of a PoI that each distinguishes."""


class Shape(Checked, place="shape"):
    """A shape of PoIs: an upright cylinder or box, `POI_HEIGHT` high.

    Attributes:
      primitive: The solid.
      half_sides: Half the sides of a box, or the radius of a cylinder twice, as shares of
        arena.poi_radius from 0.5 to 1.
    """

    primitive: Literal["cylinder", "box"]
    half_sides: tuple[float, float] = limited((1.0, 1.0), at_least=_MIN_SHARE, at_most=1)

    def check(self) -> None:
        """Checks that a cylinder is round; raises `ConfigError`."""
        fits = not self.is_round or self.half_sides[0] == self.half_sides[1]
        require(fits, self, "half_sides", "must be the same number twice for a cylinder")

    @property
    def is_round(self) -> bool:
        """Whether it is a cylinder."""
        return self.primitive == "cylinder"


class Attribute(Checked, place="attribute"):
    """A numeric property of each PoI besides colour and shape, for example its temperature.

    Attributes:
      values: Number of each word that a class can have.
      elsewhere: The number of walls and robots.
    """

    values: Mapping[str, float]
    elsewhere: float = 0.0

    def check(self) -> None:
        """Checks the words; raises `ConfigError`."""
        require_words(self.values, "attribute.values")
        require(len(self.values) > 0, self, "values", "must name one or more")


COLOURS: Mapping[str, tuple[float, float, float]] = FrozenDict(
    {
        "red": (0.8, 0.1, 0.1),
        "green": (0.1, 0.7, 0.1),
        "blue": (0.1, 0.2, 0.8),
        "yellow": (0.8, 0.7, 0.1),
    }
)
"""Built-in colours: albedo, linear RGB in [0, 1]."""

SHAPES: Mapping[str, Shape] = FrozenDict({"cylinder": Shape("cylinder"), "cube": Shape("box")})
"""Built-in shapes of PoIs."""


def require_words(names: Mapping[str, object], field: str) -> None:
    """Checks that each name is one word.

    Args:
      names: a dictionary from names.
      field: the setting.

    Raises:
      ConfigError: if a name is something else.
    """
    for name in names:
        if not re.fullmatch(rf"[\w-]{{1,{_MAX_NAME}}}", name):
            reason = f"must be a word of 1 to {_MAX_NAME} letters, digits, - and _"
            raise ConfigError(field, name, reason)


Value = tuple[float, float, float] | Shape | float
"""Value of a word of a class: RGB, a shape, or a number."""


class ArenaConfig(Section, place="arena"):
    """The square arena, its points of interest (PoIs) and the classes they are drawn from.

    Attributes:
      side: Inner length and width of the arena, in metres.
      num_pois: Number of points of interest, or the largest one.
      fewest_pois: Smallest number of points of interest, from which to `num_pois` each arena's
        number is drawn; 0 for always `num_pois`.
      inner_walls: Number of walls inside the arena, at random places; one without room is left out.
      poi_radius: Radius of a cylinder and half the side of a cube, in metres; unit of the sides of
        custom shapes.
      poi_gap: Minimum gap between two PoIs, in metres; a robot needs 0.1 to pass.
      classes: Classes of PoIs, all equally likely: `"COLOUR SHAPE"`, and a word per custom
        attribute.
      colours: Albedo of each colour, linear RGB in [0, 1].
      shapes: Geometry of each shape. Rays are tested against every shape at every PoI, used or not.
      attributes: Attributes besides colour and shape, for custom sensors.
    """

    side: float = limited(3.0, above=0, at_most=100)
    num_pois: int = limited(3, at_least=1, at_most=64)
    fewest_pois: int = limited(0, at_least=0)
    inner_walls: int = limited(0, at_least=0, at_most=16)
    poi_radius: float = limited(0.1, above=0)
    poi_gap: float = limited(0.3, above=0)
    classes: tuple[str, ...] = limited(("green cylinder", "red cylinder", "red cube"), min_items=2)
    colours: Mapping[str, tuple[float, float, float]] = limited(COLOURS, at_least=0, at_most=1)
    shapes: Mapping[str, Shape] = SHAPES
    attributes: Mapping[str, Attribute] = FrozenDict()

    def check(self) -> None:
        """Checks names, classes and room for the PoIs.

        Raises:
          ConfigError: if one of them is wrong.
        """
        for field, names in (("colours", self.colours), ("shapes", self.shapes)):
            require_words(names, f"arena.{field}")
            require(len(names) > 0, self, field, "must name one or more")
        require_words(self.attributes, "arena.attributes")
        for name in ("colour", "shape"):
            if name in self.attributes:
                raise ConfigError("arena.attributes", name, "already exists")
        self._check_classes()
        most = math.floor(self.side / self.poi_pitch) ** 2
        expected = (
            f"must be at most {most}: no more PoIs of radius {self.poi_radius} m with gaps of "
            f"{self.poi_gap} m fit into an arena of side {self.side} m"
            if most
            else "no PoI fits; lower arena.poi_gap or arena.poi_radius, or raise arena.side"
        )
        require(self.num_pois <= most, self, "num_pois", expected)
        expected = f"must be at most num_pois = {self.num_pois}"
        require(self.fewest_pois <= self.num_pois, self, "fewest_pois", expected)

    def _check_classes(self) -> None:
        """Classes must consist of known words, and differ in what sensors measure."""
        form = " ".join(name.upper() for name in self._words)
        kinds = " and ".join(f"a {n} of {', '.join(known)}" for n, known in self._words.items())
        for name in self.classes:
            words = name.split(" ")
            is_known = len(words) == len(self._words) and all(
                w in known for w, known in zip(words, self._words.values(), strict=True)
            )
            require(is_known, self, "classes", f'{name!r} must be "{form}" with {kinds}')
        is_once = len(set(self.classes)) == len(self.classes)
        require(is_once, self, "classes", "must name no class twice")
        # A PoI may have any yaw.
        shapes = {w: (x.primitive, *sorted(x.half_sides)) for w, x in self.shapes.items()}
        for name, values in {**self._words, "shape": shapes}.items():
            of_values: dict[object, str] = {}
            for word in self.labels(name):
                twin = of_values.setdefault(values[word], word)
                expected = (
                    f"must not use both {twin!r} and {word!r}, which no sensor can distinguish"
                )
                require(twin == word, self, "classes", expected)

    @property
    def density(self) -> float:
        """Expected number of PoIs on a square metre."""
        return (self.num_pois + (self.fewest_pois or self.num_pois)) / 2 / self.side**2

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
    def _words(self) -> dict[str, Mapping[str, Value]]:
        """For each word of a class, its attribute and the possible values."""
        own = {name: attribute.values for name, attribute in self.attributes.items()}
        return {"colour": self.colours, "shape": self.shapes, **own}

    def values(self, attribute: str) -> tuple[Value, ...]:
        """For each class, the value of its word: RGB, a `Shape`, or a number."""
        known = self._words[attribute]
        return tuple(known[word] for word in self.words(attribute))

    def labels(self, attribute: str) -> tuple[str, ...]:
        """Distinct colours, shapes or other words of the classes, in order of declaration.

        By default ("red", "green") and ("cylinder", "cube"): the order of `colours` and `shapes`,
        and of the paper's feature vectors.
        """
        used = self.words(attribute)
        return tuple(label for label in self._words[attribute] if label in used)

    def label_of_class(self, attribute: str) -> tuple[int, ...]:
        """For each class, the index of its colour, shape or other word in `labels(attribute)`."""
        labels = self.labels(attribute)
        return tuple(labels.index(word) for word in self.words(attribute))

    def words(self, attribute: str) -> list[str]:
        """For each class, its word for an attribute."""
        position = list(self._words).index(attribute)
        return [name.split(" ")[position] for name in self.classes]


class LidarConfig(Section, place="lidar"):
    """The AMiRo's LiDAR, a Hokuyo URG-04LX.

    Attributes:
      num_beams: Beams per scan.
      field_of_view: Angle between the first and the last beam, in degrees.
      min_range: Shortest measured distance, in metres.
      max_range: Longest measured distance, in metres; simulated beams without a return read it,
        too.
      range_noise: Standard deviation of a measured distance, in metres; `range_noise_growth` adds
        to it.
      range_noise_growth: Growth of that standard deviation with the distance, in metres per metre.
      mixed_pixels: Probability that a beam returns a distance between that of its surface and that
        of its neighbour's, if both are in range; at an edge, this is a point in empty space.
      dropout: Probability that a beam has no return.
      window: Number of beams around the PoI's bearing that the detector reads.
      window_range: Distance at which the detector's input is clipped, in metres; removes the
        background.
    """

    num_beams: int = limited(683, at_least=1, at_most=100_000)
    field_of_view: float = limited(240.0, above=0, at_most=360)
    min_range: Traced[float] = limited(0.08, above=0)
    max_range: Traced[float] = limited(5.0, above=0, at_most=1000)
    range_noise: Traced[float] = limited(0.01, at_least=0)
    range_noise_growth: float = limited(0.0, at_least=0, at_most=1)
    mixed_pixels: float = limited(0.0, at_least=0, at_most=1)
    dropout: float = limited(0.0, at_least=0, at_most=1)
    window: int = limited(128, at_least=1)
    window_range: Traced[float] = limited(1.5, above=0)

    def check(self) -> None:
        """Checks the order of distances, and the window; raises `ConfigError`."""
        least, most = f"above min_range = {self.min_range}", f"at most max_range = {self.max_range}"
        require(self.max_range > self.min_range, self, "max_range", f"must be {least}")
        require(self.window_range > self.min_range, self, "window_range", f"must be {least}")
        require(self.range_noise <= self.max_range, self, "range_noise", f"must be {most}")
        _check_window(self, self.num_beams, 1)


class CameraConfig(Section, place="camera"):
    """The AMiRo's camera, of which one line of pixels is used.

    Attributes:
      num_pixels: Number of pixels of the scanline.
      field_of_view: Horizontal field of view, in degrees.
      pixel_noise: Standard deviation of a pixel's value, where 1 is full scale.
      exposure_error: Standard deviation of the natural logarithm of an image's brightness.
      colour_cast: Standard deviation of the natural logarithm of each channel's brightness in an
        image.
      low_light: Maximum share of the light that may be missing in an image; the share is uniform
        from 0.
      shadow: Probability of a shadow: on one side of a random pixel of the image, only ambient
        light remains. It, exposure, cast and low light drift with time and place, see `sim.light`.
      window: Number of pixels around the PoI's bearing that the detector reads.
      stride: Step between the pixels that the detector reads, in pixels.
    """

    num_pixels: int = limited(640, at_least=1, at_most=100_000)
    field_of_view: float = limited(80.0, above=0, below=180)
    pixel_noise: Traced[float] = limited(0.007, at_least=0, at_most=1)
    exposure_error: float = limited(0.0, at_least=0, at_most=10)
    colour_cast: float = limited(0.0, at_least=0, at_most=10)
    low_light: float = limited(0.0, at_least=0, at_most=1)
    shadow: float = limited(0.0, at_least=0, at_most=1)
    window: int = limited(80, at_least=1)
    stride: int = limited(4, at_least=1)

    def check(self) -> None:
        """Checks the window; raises `ConfigError`."""
        _check_window(self, self.num_pixels, self.stride)


class ViewpointConfig(Section, place="viewpoint"):
    """Viewpoints from which a robot looks at a PoI.

    Attributes:
      min_distance: Shortest distance from the sensor to the PoI's centre, in metres.
      max_distance: Longest distance from the sensor to the PoI's centre, in metres.
      bearing_error: Largest error of the bearing on which the detector's window is centred, in
        degrees.
    """

    min_distance: Traced[float] = limited(0.3, above=0)
    max_distance: Traced[float] = limited(1.2, above=0)
    bearing_error: Traced[float] = limited(1.0, at_least=0, at_most=10)

    def check(self) -> None:
        """Checks the order of distances; raises `ConfigError`."""
        expected = f"must be above min_distance = {self.min_distance}"
        require(self.max_distance > self.min_distance, self, "max_distance", expected)


class SensorConfig(Checked, place="sensor"):
    """A custom sensor, which a robot carries like the camera or the LiDAR.

    Attributes:
      make: Function that makes the `sim.Sensor` from a `Config`, as `package.module:function`: a
        name, so that runs can store it.
      attribute: Attribute that the sensor distinguishes: `colour`, `shape` or one of
        `arena.attributes`.
    """

    make: str
    attribute: str

    def check(self) -> None:
        """Checks that `make` can be the name of a function; raises `ConfigError`."""
        require(is_function_name(self.make), self, "make", "must be package.module:function")


def _check_window(sensor: LidarConfig | CameraConfig, num_rays: int, stride: int) -> None:
    """Raises `ConfigError` unless a sensor's window fits its rays."""
    most = (num_rays - 1) // stride + 1
    expected = f"must be at most {most}: it has {num_rays} rays, with a stride of {stride}"
    require(sensor.window <= most, sensor, "window", expected)
