"""The two halves of the picture: the arena from above, and the shared map."""

from collections.abc import Mapping
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import ArrayLike

from jaxsense.config import ROBOT_RADIUS, Config
from jaxsense.core.types import Belief
from jaxsense.mission import MissionState, Record
from jaxsense.mission.state import ENDED, FACING
from jaxsense.show.animation.svg import Timeline, add
from jaxsense.show.colours import as_hex, class_colour, in_plane, modality_colour, plane

SIZE = 340  # px, of a view
_FLASH = 6  # frames that a look is shown for
_READABLE = 9.0  # px, radius of a PoI that its number fits into
_MOST_ABREAST = 4  # numbers
_SMOOTHING = 8  # frames in which an ellipse comes to its new shape


class ArenaView:
    """The arena from above: PoIs, robots, their trails, fields of view and looks."""

    def __init__(self, config: Config, end: MissionState, fields_of_view: Mapping[str, float]):
        self._config, self._end, self._fields_of_view = config, end, fields_of_view
        self._scale = SIZE / config.arena.side

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
        for r in range(len(self._config.carried)):
            self._draw_looks(parent, timeline, record, r)
            self._draw_robot(parent, fields, timeline, record, r)

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
        if shape.primitive == "cylinder":
            add(group, "circle", r=u, fill=colour)
        else:
            turn = f"rotate({-np.degrees(float(layout.yaw[n])):.1f})"
            box = add(group, "rect", x=-u, y=-v, width=2 * u, height=2 * v, rx=1, fill=colour)
            box.set("transform", turn)
        if radius < _READABLE:
            beside = {"x": radius + 12, "fill": colour, "class_": "film-number film-on-light"}
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
        shape = _sector(reach, self._fields_of_view[self._config.carried[r]])
        view = add(field, "path", d=shape, fill=colour)
        phase, is_blind = record.phase[:, r], record.time >= self._end.faults.blind_at[r]
        opacity = np.where(phase == FACING, 0.34, 0.16)
        timeline.animate(
            view, "opacity", np.where((phase >= ENDED) | is_blind, 0.0, opacity), jumps=True
        )
        add(body, "circle", r=radius + 2, fill=colour, stroke="#fff", stroke_width=1.5)
        add(body, "path", d=f"M1,0H{radius:.1f}", stroke="#fff", stroke_width=2.5)


class MapView:
    """The latent space: the classes, and the belief of every PoI."""

    def __init__(self, config: Config, end: MissionState, class_beliefs: Belief):
        self._config, self._end = config, end
        self._plane = plane(np.asarray(class_beliefs.mean))
        self._means, self._stds = map(self._in_plane, (class_beliefs.mean, class_beliefs.std))
        self._scale = SIZE / 2 / (1.0 + float(np.max(np.abs(self._means) + self._stds)))

    def _in_plane(self, values: ArrayLike) -> np.ndarray:
        """`[..., D]` as `[..., 2]`, in the dimensions that are shown."""
        return in_plane(values, self._plane)

    def draw(self, parent: Element, timeline: Timeline, record: Record) -> None:
        """Adds the view.

        Args:
          parent: group whose origin is the view's upper left corner.
          timeline: when the frames are shown.
          record: `[F]` frames of the mission.
        """
        arena = self._config.arena
        colours = [as_hex(class_colour(arena, label)) for label in arena.classes]
        for colour, mean in zip(colours, self._means, strict=True):
            x, y = self._place(mean)
            add(parent, "circle", cx=x, cy=y, r=3, fill=colour)
        numbers = add(parent, "g")
        num_pois = self._config.arena.num_pois
        # Before the first look, ellipses exceed the view; each is slightly smaller than the last.
        step = min(4.0, SIZE / 4 / num_pois)
        for n in range(num_pois):
            mean = self._place(_smooth(self._in_plane(record.belief.mean[:, n])))
            widest = SIZE / 2 - 5 - step * n
            std = self._scale * self._in_plane(record.belief.std[:, n])
            radii = _smooth(np.minimum(std, widest))
            colour = colours[int(self._end.classes[n])]
            ellipse = add(parent, "ellipse", fill=colour, stroke=colour)
            ellipse.set("stroke-width", "2.5")
            for name, values in zip(("cx", "cy", "rx", "ry"), (*mean.T, *radii.T), strict=True):
                timeline.animate(ellipse, name, values)
            is_seen = record.seen[:, n].any(axis=-1)
            timeline.animate(
                ellipse, "stroke-dasharray", np.where(is_seen, "1 0", "2 5").tolist(), jumps=True
            )
            timeline.animate(ellipse, "fill-opacity", 0.1 * is_seen, jumps=True)
            # Numbers of PoIs at the same place in the map stand side by side.
            number = add(numbers, "g")
            timeline.animate(number, "translate", mean + _beside(n, num_pois))
            add(number, "text", str(n + 1), class_="film-number film-on-light", fill=colour)
        self._draw_labels(parent, colours)

    def _draw_labels(self, parent: Element, colours: list[str]) -> None:
        """The names of the classes, beyond the ellipses that are as small as they get."""
        for label, colour, mean, std in zip(
            self._config.arena.classes, colours, self._means, self._stds, strict=True
        ):
            x, y = self._place(mean)
            side = -1 if mean[1] >= 0 else 1
            add(
                parent,
                "text",
                label,
                x=np.clip(x, 60, SIZE - 60),
                y=y + side * (self._scale * std[1] + 12) + 5,
                fill=colour,
                class_="film-label film-on-light",
            )

    def _place(self, mean: ArrayLike) -> np.ndarray:
        """`[..., 2]` latent, upwards from the middle, in pixels, downwards from the corner."""
        return SIZE / 2 + self._scale * np.asarray(mean) * (1, -1)


def _beside(n: int, num_pois: int) -> np.ndarray:
    """Where the number of a PoI stands from its place in the map: in rows of four at most."""
    columns = min(num_pois, _MOST_ABREAST)
    row, column = divmod(n, columns)
    rows = -(-num_pois // columns)
    width = 14 if num_pois < 10 else 20  # px, of one or two digits
    return np.array([width * (column - (columns - 1) / 2), 15 * (row - (rows - 1) / 2) - 6])


def _sector(radius: float, angle: float) -> str:
    """A sector around the x axis, as a path; the angle in degrees."""
    half = np.radians(min(angle, 359.9) / 2)
    x, y = radius * np.cos(half), radius * np.sin(half)
    return (
        f"M0,0L{x:.1f},{-y:.1f}A{radius:.1f},{radius:.1f} 0 {int(angle > 180)} 1 {x:.1f},{y:.1f}Z"
    )


def _smooth(values: np.ndarray) -> np.ndarray:
    """`[F, 2]` with each jump as a short way."""
    before = np.repeat(values[:1], _SMOOTHING - 1, axis=0)
    windows = np.lib.stride_tricks.sliding_window_view(
        np.concatenate([before, values]), _SMOOTHING, axis=0
    )
    return windows.mean(axis=-1)
