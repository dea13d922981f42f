"""The left half of the picture: the arena from above."""

from collections.abc import Mapping
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import ArrayLike

from jaxsense.config import ROBOT_RADIUS, Config
from jaxsense.mission import MissionState, Record
from jaxsense.mission.state import ENDED, FACING
from jaxsense.show.animation.svg import SIZE, Timeline, add, smooth
from jaxsense.show.colours import as_hex, class_colour, modality_colour

_FLASH = 6  # frames that a look is shown for
_READABLE = 9.0  # px, radius of a PoI that its number fits into
_NUMBER, _DIGIT = 12.0, 5.0  # px, from a small PoI to the middle of its number, and half a digit
_GAP = 4.0  # px, between a PoI and its bars
_BARS, _BAR, _TALL = 26.0, 6.0, 24.0  # px: most of all bars abreast, most of one, and height


class ArenaView:
    """The arena from above: PoIs with what is known, robots, their trails, views and looks."""

    def __init__(
        self,
        config: Config,
        end: MissionState,
        fields_of_view: Mapping[str, float],
        probabilities: np.ndarray,
    ):
        """Prepares the view.

        Args:
          config: all settings.
          end: the state in which the mission ended.
          fields_of_view: of each sensor, by its name, in degrees.
          probabilities: `[F, N, C]` of the classes, in the map.
        """
        self._config, self._end, self._fields_of_view = config, end, fields_of_view
        self._probabilities = probabilities
        self._scale = SIZE / config.arena.side
        radius = self._scale * config.arena.poi_radius
        # With its number, if that stands to the right of it.
        number = _NUMBER + _DIGIT * len(str(config.arena.num_pois)) if self._is_small else 0.0
        reach = np.array([radius, radius, radius + number, radius])
        size = np.array([_width(len(config.arena.classes)) * len(config.arena.classes), _TALL])
        self._bars_at = _corners(self._place(end.scene.layout.position), reach, size)

    def draw(self, parent: Element, timeline: Timeline, record: Record) -> None:
        """Adds the view.

        Args:
          parent: group whose origin is the view's upper left corner.
          timeline: when the frames are shown.
          record: `[F]` frames of the mission.
        """
        for r in range(len(self._config.carried)):
            self._draw_trail(parent, timeline, record, r)
        fields = add(parent, "g")
        for n in range(self._config.arena.num_pois):
            self._draw_poi(parent, timeline, record, n)
            self._draw_bars(parent, timeline, record, n)
        for r in range(len(self._config.carried)):
            self._draw_looks(parent, timeline, record, r)
            self._draw_robot(parent, fields, timeline, record, r)

    def field_of_view(self, r: int, reach: float) -> str:
        """A robot's field of view as a path around the x axis, `reach` px long."""
        return _sector(reach, self._fields_of_view[self._config.carried[r]])

    def _colour(self, r: int) -> str:
        return modality_colour(self._config.modality_of_robot[r])

    def _place(self, position: ArrayLike) -> np.ndarray:
        """`[..., 2]` metres, y upwards from the middle, in pixels, y downwards from the corner."""
        return SIZE / 2 + self._scale * np.asarray(position)[..., :2] * (1, -1)

    def _draw_trail(self, parent: Element, timeline: Timeline, record: Record, r: int) -> None:
        places = self._place(record.poses[:, r])
        steps = np.linalg.norm(np.diff(places, axis=0), axis=-1)
        length = np.concatenate([[0.0], np.cumsum(steps)])
        is_new = np.concatenate([[True], steps > 0.05])
        line = add(
            parent,
            "polyline",
            points=" ".join(f"{x:.1f},{y:.1f}" for x, y in places[is_new]),
            fill="none",
            stroke=self._colour(r),
            stroke_width=2,
            stroke_opacity=0.6,
        )
        if length[-1] > 0:
            line.set("stroke-dasharray", f"{length[-1] + 1:.1f}")
            timeline.animate(line, "stroke-dashoffset", length[-1] + 1 - length)

    def _draw_poi(self, parent: Element, timeline: Timeline, record: Record, n: int) -> None:
        layout, arena = self._end.scene.layout, self._config.arena
        x, y = self._place(layout.position[n])
        radius = self._scale * arena.poi_radius
        colour = as_hex(class_colour(arena, arena.classes[int(self._end.classes[n])]))
        group = add(parent, "g", transform=f"translate({x:.1f} {y:.1f})")
        shape = list(arena.shapes.values())[int(layout.shape[n])]
        u, v = (radius * share for share in shape.half_sides)
        if shape.is_round:
            add(group, "circle", r=u, fill=colour)
        else:
            turn = f"rotate({-np.degrees(float(layout.yaw[n])):.1f})"
            box = add(group, "rect", x=-u, y=-v, width=2 * u, height=2 * v, rx=1, fill=colour)
            box.set("transform", turn)
        if self._is_small:
            beside = {"x": radius + _NUMBER, "fill": colour, "class_": "film-number film-on-light"}
        else:
            beside = {"x": 0, "fill": "#fff", "class_": "film-number"}
        add(group, "text", str(n + 1), y=5, **beside)
        num_modalities = len(self._config.modalities)
        for m in range(num_modalities):  # which sensors have written it into the map
            mark = add(
                group,
                "circle",
                cx=13 * (m - (num_modalities - 1) / 2),
                cy=-1.42 * radius - 7,
                r=4.5,
                fill=modality_colour(m),
                stroke="#fff",
            )
            timeline.animate(mark, "opacity", record.seen[:, n, m], jumps=True)

    def _draw_bars(self, parent: Element, timeline: Timeline, record: Record, n: int) -> None:
        """Bars next to a PoI, which fill with the probabilities of its classes."""
        arena = self._config.arena
        left, top = self._bars_at[n]
        # Upwards, so that only the height changes.
        place = f"translate({left:.1f} {top + _TALL:.1f}) scale(1 -1)"
        group = add(parent, "g", transform=place)
        width = _width(len(arena.classes))
        across = width * len(arena.classes)
        paper = {"width": across + 2, "height": _TALL + 2, "fill": "#fff", "opacity": 0.75}
        add(group, "rect", x=-1, y=-1, rx=2, **paper)
        heights = _TALL * smooth(self._probabilities[:, n])
        for c, label in enumerate(arena.classes):
            colour = as_hex(class_colour(arena, label))
            bar = add(group, "rect", x=width * c, width=0.85 * width, fill=colour)
            timeline.animate(bar, "height", heights[:, c])
        x, y = self._place(self._end.scene.layout.position[n])
        below = self._scale * arena.poi_radius + 15
        is_low = y + below > SIZE - 4
        text = add(parent, "text", "unknown", class_="film-unknown film-on-light")
        text.set("x", f"{np.clip(x, 26, SIZE - 26):.1f}")
        text.set("y", f"{y - below + 8 if is_low else y + below:.1f}")
        is_seen = record.seen[:, n].any(axis=-1)
        timeline.animate(text, "opacity", 1.0 - is_seen, jumps=True)

    @property
    def _is_small(self) -> bool:
        """Whether PoIs are too small for their numbers."""
        return self._scale * self._config.arena.poi_radius < _READABLE

    def _draw_looks(self, parent: Element, timeline: Timeline, record: Record, r: int) -> None:
        """Line from the robot to the PoI that it scans."""
        for i in np.flatnonzero(record.scanned[:, r]):
            target = int(record.target[max(i - 1, 0), r])
            if target >= self._config.arena.num_pois:
                continue
            (x1, y1), (x2, y2) = map(
                self._place, (record.poses[i, r], self._end.scene.layout.position[target])
            )
            line = add(parent, "line", x1=x1, y1=y1, x2=x2, y2=y2, stroke=self._colour(r))
            line.set("stroke-width", "3")
            since = np.arange(len(record.time)) - i
            timeline.animate(
                line, "opacity", np.where(since < 0, 0.0, np.maximum(1 - since / _FLASH, 0.0))
            )

    def _draw_robot(
        self, parent: Element, fields: Element, timeline: Timeline, record: Record, r: int
    ) -> None:
        places = self._place(record.poses[:, r])
        angles = -np.degrees(np.unwrap(record.poses[:, r, 2]))
        colour, radius = self._colour(r), self._scale * ROBOT_RADIUS
        field, robot = (add(each, "g") for each in (fields, parent))
        for group in (field, robot):
            timeline.animate(group, "translate", places)
        field, body = (add(each, "g") for each in (field, robot))
        for group in (field, body):
            timeline.animate(group, "rotate", angles)
        reach = self._scale * self._config.navigation.view_range
        view = add(field, "path", d=self.field_of_view(r, reach), fill=colour)
        phase, is_blind = record.phase[:, r], record.time >= self._end.faults.blind_at[r]
        opacity = np.where(phase == FACING, 0.34, 0.16)
        timeline.animate(
            view, "opacity", np.where((phase >= ENDED) | is_blind, 0.0, opacity), jumps=True
        )
        add(body, "circle", r=radius + 2, fill=colour, stroke="#fff", stroke_width=1.5)
        add(body, "path", d=f"M1,0H{radius:.1f}", stroke="#fff", stroke_width=2.5)


def _width(number: int) -> float:
    """Width of each of a number of bars, in px."""
    return min(_BAR, _BARS / number)


def _corners(middles: np.ndarray, reach: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Where bars stand next to each PoI: `[N, 2]` upper left corners in px.

    They stand to its right, left, below or above it, in the view and where they cover least of
    other PoIs and of bars.

    Args:
      middles: `[N, 2]` of the PoIs.
      reach: `[4]` of each PoI to the left, up, right and down.
      size: `[2]` of the bars.
    """
    taken = np.concatenate([middles - reach[:2], middles + reach[2:]], axis=1)
    found = []
    for middle in middles:
        to_left, up, to_right, down = reach + _GAP
        places = middle + np.array(
            [
                (to_right, -size[1] / 2),
                (-to_left - size[0], -size[1] / 2),
                (-size[0] / 2, down),
                (-size[0] / 2, -up - size[1]),
            ]
        )
        low, high = np.maximum(places[:, None], taken[:, :2]), places[:, None] + size
        covered = np.maximum(np.minimum(high, taken[:, 2:]) - low, 0).prod(axis=-1).sum(axis=-1)
        outside = (places < 0).any(axis=-1) | (places + size > SIZE).any(axis=-1)
        found.append(places[np.argmin(covered + SIZE**2 * outside)])
        taken = np.concatenate([taken, [[*found[-1], *(found[-1] + size)]]])
    return np.array(found)


def _sector(radius: float, angle: float) -> str:
    """A sector around the x axis, as a path; the angle in degrees."""
    half = np.radians(min(angle, 359.9) / 2)
    x, y = radius * np.cos(half), radius * np.sin(half)
    return (
        f"M0,0L{x:.1f},{-y:.1f}A{radius:.1f},{radius:.1f} 0 {int(angle > 180)} 1 {x:.1f},{y:.1f}Z"
    )
