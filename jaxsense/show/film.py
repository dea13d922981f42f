"""A mission as a moving picture: an SVG that any browser plays, without a script."""

from collections.abc import Mapping
from importlib import resources
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import jax
import numpy as np

from jaxsense.config import Config
from jaxsense.config.mission import CONTROL_PERIOD
from jaxsense.core.types import Belief, Fusion
from jaxsense.mission import MissionState, Record
from jaxsense.show.colours import modality_colour
from jaxsense.show.film_views import SIZE, Scene, draw_arena, draw_map
from jaxsense.show.svg import Timeline, add

WIDTH = 2 * SIZE + 40
_SPEED = 2.0  # times real time
_AFTER = 10  # frames shown after the mission's end
_PAUSE = 2.5  # s that the last one stays
_TIMES = 3  # that it plays
_TOP, _LINE = 38, 26
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
      lasts: minimum duration in seconds of the mission. Give two films the same to keep them in
        step while they repeat.

    Returns:
      The content of the file.
    """
    seconds = duration_of(config, end)
    last = round(max(seconds, lasts) / CONTROL_PERIOD)
    record = _frames(config, records, fusion.prior, last)
    shown = np.asarray(record.time) / _SPEED
    duration = float(shown[-1]) + _PAUSE
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
    probabilities = np.asarray(_class_probabilities(fusion, record.belief))
    scene = Scene(config, end, fusion, fields_of_view, record, probabilities, timeline)
    add(root, "rect", class_="film-paper", width=WIDTH, height=height)
    left, right = _half(root, 0, title), _half(root, 1, "the shared map")
    clock = [f"{t:.0f} s" for t in np.floor(record.time)]
    is_over = record.time >= seconds - 1e-3
    clock = np.where(is_over, f"{seconds:.1f} s", clock).tolist()
    timeline.strip(left, clock, x=SIZE, y=25, class_="film-title film-end")
    draw_arena(_view(left), scene)
    draw_map(_view(right), scene)
    below = _TOP + SIZE + 24
    _draw_robots(left, scene, below)
    note = "Bars: probabilities; dots: sensors that saw it."
    add(left, "text", note, y=below + _LINE * len(config.carried), class_="film-note")
    for line, note in enumerate(_NOTES):
        add(right, "text", note, y=below + _LINE * line, class_="film-note")
    return ElementTree.tostring(root, encoding="unicode") + "\n"


def duration_of(config: Config, end: MissionState) -> float:
    """Seconds from the beginning of a mission until its end."""
    return CONTROL_PERIOD * int(end.steps)


@jax.jit
def _class_probabilities(fusion: Fusion, belief: Belief) -> jax.Array:
    """`[F, N, C]` of `[F, N, D]` beliefs."""
    return jax.vmap(jax.vmap(fusion.class_probabilities))(belief)


def _frames(config: Config, records: Record, prior: Belief, last: int) -> Record:
    """The frames from just before a mission until shortly after the `last` control period."""
    rows = np.minimum(np.arange(-1, last + _AFTER).clip(0), len(records.time) - 1)
    record: Record = jax.tree.map(lambda x: np.array(np.asarray(x)[rows]), records)
    record.time[:] = CONTROL_PERIOD * np.arange(len(rows))
    record.seen[0], record.scanned[0], record.detected[0] = False, False, False
    record.phase[0], record.target[0] = 0, config.arena.num_pois
    record.belief.mean[0], record.belief.std[0] = prior.mean, prior.std
    return record


def _half(parent: Element, number: int, title: str) -> Element:
    half = add(parent, "g", transform=f"translate({10 + number * (SIZE + 20)} 0)")
    add(half, "text", title, y=25, class_="film-title")
    return half


def _view(half: Element) -> Element:
    """Adds the floor of a view, and what shows no more than the view."""
    add(half, "rect", class_="film-floor", y=_TOP, width=SIZE, height=SIZE, rx=6)
    return add(half, "svg", y=_TOP, width=SIZE, height=SIZE)


def _draw_robots(parent: Element, scene: Scene, y: float) -> None:
    """Draws a line for each robot: its colour, its name and what it does."""
    config, record = scene.config, scene.record
    for r, named in enumerate(config.robot_names):
        colour = modality_colour(config.modality_of_robot[r])
        add(parent, "circle", cx=9, cy=y - 6 + _LINE * r, r=7, fill=colour)
        doing = [
            f"{named.replace('_', ' ')}: {_doing(int(phase), int(target), config.arena.num_pois)}"
            for phase, target in zip(record.phase[:, r], record.target[:, r], strict=True)
        ]
        scene.timeline.strip(parent, doing, x=28, y=y + _LINE * r, class_="film-line")


def _doing(phase: int, target: int, num_pois: int) -> str:
    """A robot's phase in words."""
    has_target = 1 <= phase <= 3 and target < num_pois
    return f"{_PHASES[phase]} {target + 1}" if has_target else _PHASES[phase]
