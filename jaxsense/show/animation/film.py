"""The whole picture: both views, the activity of each robot, and the time."""

from collections.abc import Mapping
from importlib import resources
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import jax
import numpy as np

from jaxsense.config import Config
from jaxsense.core.types import Belief, Fusion
from jaxsense.mission import MissionState, Record
from jaxsense.show.animation.arena import ArenaView
from jaxsense.show.animation.latent_map import MapView
from jaxsense.show.animation.svg import SIZE, Timeline, add, strip
from jaxsense.show.colours import modality_colour

WIDTH = 2 * SIZE + 40
_SPEED = 2.0  # times real time
_AFTER = 10  # frames shown after the mission's end
_PAUSE = 2.5  # s that the last one stays
_TIMES = 3  # that it plays
_TINY = 1e-3  # s, less than a control period
_TOP, _LINE = 38, 26
_ICON = 14  # px, length of a field of view next to the name of a robot
_PHASES = ("choosing", "driving to", "looking at", "backing off from", "done", "failed")
_NOTES = (
    "Ellipse: 1-sigma belief about a numbered PoI.",
    "Identified PoIs are listed at their class.",
    "Dotted circle: PoIs that no robot has seen.",
)
_STYLE = "\n" + (resources.files("jaxsense.show") / "film.css").read_text(encoding="utf-8")


def draw(
    config: Config,
    records: Record,
    end: MissionState,
    fusion: Fusion,
    fields_of_view: Mapping[str, float],
    title: str,
    lasts: float = 0.0,
) -> str:
    """Draws a mission as an animated SVG.

    Args:
      config: all settings.
      records: `[steps]` of all control periods.
      end: the state in which the mission ended.
      fusion: of the map, whose prior and classes are shown in it.
      fields_of_view: of each sensor, by its name, in degrees.
      title: what to call it.
      lasts: seconds of the mission that the film shows at least, beyond its end. Films that last
        equally long stay together while they repeat.

    Returns:
      The content of the file.
    """
    seconds = duration_of(config, end)
    last = round(max(seconds, lasts) / config.mission.control_period)
    record = _frames(config, records, fusion.prior, last)
    probabilities = class_probabilities(fusion, record.belief)
    shown = np.asarray(record.time) / _SPEED
    duration = float(shown[-1]) + _PAUSE
    views = (
        ArenaView(config, end, fields_of_view, probabilities),
        MapView(config, end, fusion, probabilities),
    )
    height = _TOP + SIZE + _LINE * max(len(config.carried) + 1, len(_NOTES)) + 16
    root = Element("svg", {"xmlns": "http://www.w3.org/2000/svg", "class": "film", "role": "img"})
    root.set("viewBox", f"0 0 {WIDTH} {height}")
    root.set("style", f"--film:{duration:.2f}s {_TIMES}")
    robots = " and ".join(dict.fromkeys(config.carried))
    text = (
        f"{title}: robots with {robots} look at {config.arena.num_pois} points of interest; bars "
        f"next to each fill with the probabilities of its classes, and the ellipses of the shared "
        f"map shrink. It ends after {seconds:.1f} s."
    )
    add(root, "title", text)
    timeline = Timeline(shown / duration, add(root, "style", _STYLE))
    clip = add(add(root, "defs"), "clipPath", id="view")
    add(clip, "rect", width=SIZE, height=SIZE, rx=6)
    add(root, "rect", class_="film-paper", width=WIDTH, height=height)
    _draw(root, timeline, config, record, views, (title, seconds))
    return ElementTree.tostring(root, encoding="unicode") + "\n"


def duration_of(config: Config, end: MissionState) -> float:
    """Seconds from the beginning of a mission until its end."""
    return config.mission.control_period * int(end.steps)


def class_probabilities(fusion: Fusion, belief: Belief) -> np.ndarray:
    """`[F, N, C]` class probabilities of `[F, N, D]` beliefs."""
    return np.asarray(_class_probabilities(fusion, belief))


@jax.jit
def _class_probabilities(fusion: Fusion, belief: Belief) -> jax.Array:
    return jax.vmap(jax.vmap(fusion.class_probabilities))(belief)


def _frames(config: Config, records: Record, prior: Belief, last: int) -> Record:
    """The frames from just before a mission until shortly after the `last` control period."""
    rows = np.minimum(np.arange(-1, last + _AFTER).clip(0), len(records.time) - 1)
    record: Record = jax.tree.map(lambda x: np.array(np.asarray(x)[rows]), records)
    record.time[:] = config.mission.control_period * np.arange(len(rows))
    record.seen[0], record.scanned[0], record.detected[0] = False, False, False
    record.phase[0], record.target[0] = 0, config.arena.num_pois
    record.belief.mean[0], record.belief.std[0] = prior.mean, prior.std
    return record


def _draw(
    parent: Element,
    timeline: Timeline,
    config: Config,
    record: Record,
    views: tuple[ArenaView, MapView],
    heading: tuple[str, float],
) -> None:
    """Draws both halves."""
    (title, seconds), (arena, latent) = heading, views
    below = _TOP + SIZE + 24
    half = _half(parent, 0, title, timeline, record, arena)
    whole = np.floor(record.time)
    clock = np.where(
        record.time < seconds - _TINY, [f"{t:.0f} s" for t in whole], f"{seconds:.1f} s"
    )
    strip(half, timeline, clock.tolist(), x=SIZE, y=25, class_="film-title film-end")
    _draw_robots(half, timeline, arena, config, record, below)
    note = "Bars: probabilities; dots: sensors that saw it."
    add(half, "text", note, y=below + _LINE * len(config.carried), class_="film-note")
    half = _half(parent, 1, "the shared map", timeline, record, latent)
    for line, note in enumerate(_NOTES):
        add(half, "text", note, y=below + _LINE * line, class_="film-note")


def _half(
    parent: Element,
    number: int,
    name: str,
    timeline: Timeline,
    record: Record,
    view: ArenaView | MapView,
) -> Element:
    """Draws a view under its name; returns the half of the picture that it is in."""
    half = add(parent, "g", transform=f"translate({10 + number * (SIZE + 20)} 0)")
    add(half, "text", name, y=25, class_="film-title")
    place = add(half, "g", transform=f"translate(0 {_TOP})")
    add(place, "rect", class_="film-floor", width=SIZE, height=SIZE, rx=6)
    view.draw(add(place, "g", clip_path="url(#view)"), timeline, record)
    return half


def _draw_robots(
    parent: Element,
    timeline: Timeline,
    view: ArenaView,
    config: Config,
    record: Record,
    y: float,
) -> None:
    """Draws a line for each robot: its field of view, its name and what it does."""
    for r, named in enumerate(config.robot_names):
        colour = modality_colour(config.modality_of_robot[r])
        icon = add(parent, "g", transform=f"translate(9 {y - 6 + _LINE * r})")
        add(icon, "path", d=view.field_of_view(r, _ICON), fill=colour, opacity=0.4)
        add(icon, "circle", r=5, fill=colour)
        doing = [
            f"{named.replace('_', ' ')}: {_doing(int(phase), int(target), config.arena.num_pois)}"
            for phase, target in zip(record.phase[:, r], record.target[:, r], strict=True)
        ]
        strip(parent, timeline, doing, x=28, y=y + _LINE * r, class_="film-line")


def _doing(phase: int, target: int, num_pois: int) -> str:
    """A robot's phase in words."""
    has_target = 1 <= phase <= 3 and target < num_pois
    return f"{_PHASES[phase]} {target + 1}" if has_target else _PHASES[phase]
