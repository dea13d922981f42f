"""A mission as a moving picture: an SVG that any browser plays, without a script.

Its halves are the arena from above and the shared map.
"""

import dataclasses
from collections.abc import Mapping
from importlib import resources
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import jax
import numpy as np
from numpy.typing import ArrayLike

from jaxsense.config import Config
from jaxsense.config.mission import CONTROL_PERIOD
from jaxsense.config.scene import ROBOT_RADIUS
from jaxsense.core.types import Belief, Fusion
from jaxsense.mission import MissionState, Record
from jaxsense.mission.state import ENDED, FACING
from jaxsense.run.missions import Recording
from jaxsense.show.colours import class_colour, in_plane, modality_colour, plane
from jaxsense.show.svg import Timeline, add, smooth
from jaxsense.sim import sensors

_SIZE = 340  # px, side of a view
_WIDTH, _TOP, _LINE = 2 * _SIZE + 40, 38, 26
_SPEED = 2.0  # times real time
_AFTER = 10  # frames shown after the mission's end
_PAUSE = 2.5  # s that the last one stays
_TIMES = 3  # that it plays
_PHASES = ("choosing", "driving to", "looking at", "backing off from", "done", "failed")
_NOTES = (
    "Ellipse: 1-sigma belief about a numbered PoI.",
    "It appears with the first look at it.",
    "Dots: classes, with their names.",
)
_STYLE = "\n" + (resources.files("jaxsense.show") / "film.css").read_text(encoding="utf-8")
_FLASH = 6  # frames that a look is shown for
_GAP = 4.0  # px, between a PoI and its bars
_BARS, _BAR, _TALL = 26.0, 6.0, 24.0  # px: most of all bars abreast, most of one, and height
_ABREAST = 4  # numbers of PoIs at one place
_LETTER = 3.9  # px, half a letter of a label


@dataclasses.dataclass(frozen=True)
class _Scene:
    """What a film shows.

    Attributes:
      end: the state in which the mission ended.
      fusion: of the map.
      record: `[F]` frames of the mission.
      probabilities: `[F, N, C]` of the classes, in the map.
      timeline: when the frames are shown.
    """

    config: Config
    end: MissionState
    fusion: Fusion
    record: Record
    probabilities: np.ndarray
    timeline: Timeline

    @property
    def colours(self) -> list[str]:
        """Of the classes."""
        arena = self.config.arena
        return [class_colour(arena, label) for label in arena.classes]

    @property
    def scale(self) -> float:
        """Pixels of the arena per metre."""
        return _SIZE / self.config.arena.side

    def place(self, position: ArrayLike) -> np.ndarray:
        """`[..., 2]` metres, y upwards from the middle, in pixels, y downwards from the corner."""
        return _SIZE / 2 + self.scale * np.asarray(position)[..., :2] * (1, -1)


def draw(config: Config, recordings: Mapping[str, Recording], fusion: Fusion) -> list[str]:
    """Draws missions as animated SVGs, which last equally long.

    Args:
      recordings: of the missions, by their titles.
      fusion: of the map, whose prior and classes are shown in it.

    Returns:
      The content of each file.
    """
    last = max(int(each.end.steps) for each in recordings.values())
    return [_draw(config, each, fusion, title, last) for title, each in recordings.items()]


def _draw(config: Config, recording: Recording, fusion: Fusion, title: str, last: int) -> str:
    """Draws a mission for as long as one of `last` control periods."""
    end, seconds = recording.end, CONTROL_PERIOD * int(recording.end.steps)
    record = _frames(config, recording.records, fusion.prior, last)
    shown = np.asarray(record.time) / _SPEED
    duration = float(shown[-1]) + _PAUSE
    height = _TOP + _SIZE + _LINE * max(len(config.carried) + 1, len(_NOTES)) + 16
    root = Element("svg", {"xmlns": "http://www.w3.org/2000/svg", "class": "film", "role": "img"})
    root.set("viewBox", f"0 0 {_WIDTH} {height}")
    root.set("style", f"--film:{duration:.2f}s {_TIMES}")
    robots = " and ".join(dict.fromkeys(config.carried))
    text = (
        f"{title}: robots with {robots} look at {config.arena.num_pois} points of interest; bars "
        f"next to each fill with the probabilities of its classes, and the ellipses of the shared "
        f"map shrink. It ends after {seconds:.1f} s."
    )
    add(root, "title", text)
    timeline = Timeline(shown / duration, add(root, "style", _STYLE))
    probabilities = np.asarray(jax.vmap(jax.vmap(fusion.class_probabilities))(record.belief))
    scene = _Scene(config, end, fusion, record, probabilities, timeline)
    add(root, "rect", class_="film-paper", width=_WIDTH, height=height)
    halves = []
    for place, name in ((10, title), (30 + _SIZE, "the shared map")):
        half = add(root, "g", transform=f"translate({place} 0)")
        add(half, "text", name, y=25, class_="film-title")
        add(half, "rect", class_="film-floor", y=_TOP, width=_SIZE, height=_SIZE, rx=6)
        halves.append((half, add(half, "svg", y=_TOP, width=_SIZE, height=_SIZE)))
    (left, arena), (right, latent) = halves
    clock = [f"{t:.0f} s" for t in np.floor(record.time)]
    is_over = record.time >= seconds - 1e-3
    clock = np.where(is_over, f"{seconds:.1f} s", clock).tolist()
    timeline.strip(left, clock, x=_SIZE, y=25, class_="film-title film-end")
    _draw_arena(arena, scene)
    _draw_map(latent, scene)
    below = _TOP + _SIZE + 24
    _draw_robots(left, scene, below)
    note = "Bars: probabilities; dots: sensors that saw it."
    add(left, "text", note, y=below + _LINE * len(config.carried), class_="film-note")
    for line, note in enumerate(_NOTES):
        add(right, "text", note, y=below + _LINE * line, class_="film-note")
    return ElementTree.tostring(root, encoding="unicode") + "\n"


def _frames(config: Config, records: Record, prior: Belief, last: int) -> Record:
    """The frames from just before a mission until shortly after the `last` control period."""
    rows = np.minimum(np.arange(-1, last + _AFTER).clip(0), len(records.time) - 1)
    record: Record = jax.tree.map(lambda x: np.array(np.asarray(x)[rows]), records)
    record.time[:] = CONTROL_PERIOD * np.arange(len(rows))
    record.seen[0], record.scanned[0], record.detected[0] = False, False, False
    record.phase[0], record.target[0] = 0, config.arena.num_pois
    record.belief.mean[0], record.belief.std[0] = prior.mean, prior.std
    return record


def _draw_robots(parent: Element, scene: _Scene, y: float) -> None:
    """Draws a line for each robot: its colour, its name and what it does."""
    config, record = scene.config, scene.record
    for r, named in enumerate(config.robot_names):
        colour = modality_colour(config.modality_of_robot[r])
        add(parent, "circle", cx=9, cy=y - 6 + _LINE * r, r=7, fill=colour)
        doing = []
        for phase, target in zip(record.phase[:, r], record.target[:, r], strict=True):
            has_target = 1 <= phase <= 3 and target < config.arena.num_pois
            words = f"{named.replace('_', ' ')}: {_PHASES[phase]}"
            doing.append(f"{words} {target + 1}" if has_target else words)
        scene.timeline.strip(parent, doing, x=28, y=y + _LINE * r, class_="film-line")


def _draw_arena(parent: Element, scene: _Scene) -> None:
    """Adds the arena: PoIs with what is known, robots, their trails, fields of view and looks."""
    robots = range(len(scene.config.carried))
    for r in robots:
        _draw_trail(parent, scene, r)
    fields = add(parent, "g")
    for n in range(scene.config.arena.num_pois):
        _draw_poi(parent, scene, n)
        _draw_bars(parent, scene, n)
    for r in robots:
        _draw_looks(parent, scene, r)
        _draw_robot(parent, fields, scene, r)


def _robot_colour(scene: _Scene, r: int) -> str:
    return modality_colour(scene.config.modality_of_robot[r])


def _draw_trail(parent: Element, scene: _Scene, r: int) -> None:
    places = scene.place(scene.record.poses[:, r])
    steps = np.linalg.norm(np.diff(places, axis=0), axis=-1)
    length = np.concatenate([[0.0], np.cumsum(steps)])
    is_new = np.concatenate([[True], steps > 0.05])
    points = " ".join(f"{x:.1f},{y:.1f}" for x, y in places[is_new])
    style = {"fill": "none", "stroke": _robot_colour(scene, r), "stroke_opacity": 0.6}
    line = add(parent, "polyline", points=points, stroke_width=2, **style)
    if length[-1] > 0:
        line.set("stroke-dasharray", f"{length[-1] + 1:.1f}")
        scene.timeline.animate(line, "stroke-dashoffset", length[-1] + 1 - length)


def _draw_poi(parent: Element, scene: _Scene, n: int) -> None:
    """Draws a PoI in its shape and colour, its number, and a dot for each sensor that saw it."""
    layout, arena = scene.end.scene.layout, scene.config.arena
    x, y = scene.place(layout.position[n])
    radius, colour = scene.scale * arena.poi_radius, scene.colours[int(scene.end.classes[n])]
    group = add(parent, "g", transform=f"translate({x:.1f} {y:.1f})")
    shape = list(arena.shapes.values())[int(layout.shape[n])]
    u, v = (radius * share for share in shape.half_sides)
    if shape.is_round:
        add(group, "circle", r=u, fill=colour)
    else:
        box = add(group, "rect", x=-u, y=-v, width=2 * u, height=2 * v, rx=1, fill=colour)
        box.set("transform", f"rotate({-np.degrees(float(layout.yaw[n])):.1f})")
    add(group, "text", str(n + 1), y=5, stroke=colour, class_="film-number film-poi")
    num_modalities = len(scene.config.modalities)
    for m in range(num_modalities):
        style = {"r": 4.5, "fill": modality_colour(m), "stroke": "#fff"}
        across = 13 * (m - (num_modalities - 1) / 2)
        mark = add(group, "circle", cx=across, cy=-1.42 * radius - 7, **style)
        scene.timeline.animate(mark, "opacity", scene.record.seen[:, n, m], jumps=True)


def _draw_bars(parent: Element, scene: _Scene, n: int) -> None:
    """Draws bars beside a PoI, which fill with the probabilities of its classes."""
    width = min(_BAR, _BARS / len(scene.colours))
    across, radius = width * len(scene.colours), scene.scale * scene.config.arena.poi_radius
    x, y = scene.place(scene.end.scene.layout.position[n])
    right = x + radius + _GAP
    left = right if right + across < _SIZE else x - radius - _GAP - across
    bottom = np.clip(y + _TALL / 2, _TALL + 2, _SIZE - 2)
    # Upwards, so that only the height changes.
    group = add(parent, "g", transform=f"translate({left:.1f} {bottom:.1f}) scale(1 -1)")
    paper = {"width": across + 2, "height": _TALL + 2, "fill": "#fff", "opacity": 0.75}
    add(group, "rect", x=-1, y=-1, rx=2, **paper)
    heights = _TALL * smooth(scene.probabilities[:, n])
    for c, colour in enumerate(scene.colours):
        bar = add(group, "rect", x=width * c, width=0.85 * width, fill=colour)
        scene.timeline.animate(bar, "height", heights[:, c])


def _draw_looks(parent: Element, scene: _Scene, r: int) -> None:
    """Draws a line from the robot to each PoI that it scans."""
    record = scene.record
    for i in np.flatnonzero(record.scanned[:, r]):
        target = int(record.target[max(i - 1, 0), r])
        if target >= scene.config.arena.num_pois:
            continue
        (x1, y1), (x2, y2) = map(
            scene.place, (record.poses[i, r], scene.end.scene.layout.position[target])
        )
        style = {"stroke": _robot_colour(scene, r), "stroke_width": 3}
        line = add(parent, "line", x1=x1, y1=y1, x2=x2, y2=y2, **style)
        since = np.arange(len(record.time)) - i
        left = np.where(since < 0, 0.0, np.maximum(1 - since / _FLASH, 0.0))
        scene.timeline.animate(line, "opacity", left)


def _draw_robot(parent: Element, fields: Element, scene: _Scene, r: int) -> None:
    record, config = scene.record, scene.config
    colour, radius = _robot_colour(scene, r), scene.scale * ROBOT_RADIUS
    moved = []
    for each in (fields, parent):
        group = add(each, "g")
        scene.timeline.animate(group, "translate", scene.place(record.poses[:, r]))
        moved.append(add(group, "g"))
        angles = -np.degrees(np.unwrap(record.poses[:, r, 2]))
        scene.timeline.animate(moved[-1], "rotate", angles)
    field, body = moved
    reach = scene.scale * config.navigation.view_range
    sensor = sensors.make(config)[config.modality_of_robot[r]]
    view = add(field, "path", d=_sector(reach, sensor.field_of_view), fill=colour)
    is_blind = (record.phase[:, r] >= ENDED) | (record.time >= scene.end.faults.blind_at[r])
    opacity = np.where(record.phase[:, r] == FACING, 0.34, 0.16)
    scene.timeline.animate(view, "opacity", np.where(is_blind, 0.0, opacity), jumps=True)
    add(body, "circle", r=radius + 2, fill=colour, stroke="#fff", stroke_width=1.5)
    add(body, "path", d=f"M1,0H{radius:.1f}", stroke="#fff", stroke_width=2.5)


def _sector(radius: float, angle: float) -> str:
    """A sector around the x axis, as a path; the angle in degrees."""
    half = np.radians(min(angle, 359.9) / 2)
    x, y = radius * np.cos(half), radius * np.sin(half)
    arc = f"A{radius:.1f},{radius:.1f} 0 {int(angle > 180)} 1 {x:.1f},{y:.1f}"
    return f"M0,0L{x:.1f},{-y:.1f}{arc}Z"


def _draw_map(parent: Element, scene: _Scene) -> None:
    """Adds the latent space: the classes, and the belief of every PoI."""
    classes, record, timeline = scene.fusion.classes, scene.record, scene.timeline
    shown = plane(np.asarray(classes.mean))
    means, stds = in_plane(classes.mean, shown), in_plane(classes.std, shown)
    scale = _SIZE / 2 / (1.0 + float(np.max(np.abs(means) + stds)))

    def place(mean: ArrayLike) -> np.ndarray:
        return _SIZE / 2 + scale * in_plane(mean, shown) * (1, -1)

    def radii(std: ArrayLike) -> np.ndarray:
        return np.minimum(scale * in_plane(std, shown), _SIZE / 2 - 5)  # wider before any look

    for colour, (x, y) in zip(scene.colours, place(classes.mean), strict=True):
        add(parent, "circle", cx=x, cy=y, r=3, fill=colour)
    is_seen = np.any(record.seen, axis=-1)
    numbers = add(parent, "g")
    for n in range(scene.config.arena.num_pois):
        colour = scene.colours[int(scene.end.classes[n])]
        mean = smooth(place(record.belief.mean[:, n]))
        style = {"fill": colour, "stroke": colour, "fill_opacity": 0.1, "stroke_width": 2.5}
        ellipse = add(parent, "ellipse", **style)
        values = *mean.T, *smooth(radii(record.belief.std[:, n])).T
        for name, each in zip(("cx", "cy", "rx", "ry"), values, strict=True):
            timeline.animate(ellipse, name, each)
        timeline.animate(ellipse, "opacity", is_seen[:, n], jumps=True)
        number, (row, column) = add(numbers, "g"), divmod(n, _ABREAST)
        # Others may share the place.
        timeline.animate(number, "translate", mean + np.array([18 * column - 27, 15 * row - 6]))
        text = add(number, "text", str(n + 1), class_="film-number film-on-light", fill=colour)
        timeline.animate(text, "opacity", is_seen[:, n], jumps=True)
    for c, (label, (x, y)) in enumerate(
        zip(scene.config.arena.classes, place(classes.mean), strict=True)
    ):
        side = -1 if means[c, 1] >= 0 else 1  # away from the middle
        half = _LETTER * len(label)
        at = {"x": np.clip(x, half, _SIZE - half), "y": y + side * (scale * stds[c, 1] + 12) + 5}
        add(parent, "text", label, class_="film-label film-on-light", fill=scene.colours[c], **at)
