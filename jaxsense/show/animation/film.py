"""The whole picture: both views, the activity of each robot, and the time."""

from collections.abc import Mapping
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import jax
import numpy as np

from jaxsense.config import Config
from jaxsense.core.types import Belief, Fusion
from jaxsense.mission import MissionState, Record
from jaxsense.show.animation.svg import Timeline, add
from jaxsense.show.animation.views import SIZE, ArenaView, MapView
from jaxsense.show.colours import modality_colour

WIDTH = 2 * SIZE + 40
_SPEED = 2.0  # times real time
_AFTER = 10  # frames shown after the mission's end
_PAUSE = 2.5  # s that the last one stays
_TOP, _LINE = 38, 26
_PHASES = ("choosing", "driving to", "looking at", "backing off from", "done", "failed")
_STYLE = """
.film{--paper:#fff;--ink:#1d2129;--floor:#f2f4f7;color-scheme:light dark}
.film text{font-family:system-ui,-apple-system,"Segoe UI",Roboto,sans-serif}
.film-paper{fill:var(--paper)}.film-floor{fill:var(--floor);stroke:#9aa2ad}
.film-title{fill:var(--ink);font-size:18px;font-weight:600}
.film-line{fill:var(--ink);font-size:17px}.film-end{text-anchor:end}
.film-number{font-size:15px;font-weight:700;text-anchor:middle}
.film-label{font-size:14px;font-weight:600;text-anchor:middle}
.film-on-light{stroke:var(--floor);stroke-width:3px;paint-order:stroke;stroke-linejoin:round}
.film-still{display:none}
@media (prefers-color-scheme:dark){.film{--paper:#16181d;--ink:#e6e8ec;--floor:#dfe2e8}}
@media (prefers-reduced-motion:reduce){.film-moving{display:none}.film-still{display:inline}}
"""


def draw(
    config: Config,
    records: Record,
    end: MissionState,
    fusion: Fusion,
    fields_of_view: Mapping[str, float],
    title: str,
) -> str:
    """Draws a mission as an animated SVG.

    Args:
      config: all settings.
      records: `[steps]` of all control periods.
      end: the state in which the mission ended.
      fusion: of the map, whose prior and classes are shown in it.
      fields_of_view: of each sensor, by its name, in degrees.
      title: what to call it.

    Returns:
      The content of the file.
    """
    record, seconds = _frames(config, records, fusion.prior, int(end.steps))
    shown = np.asarray(record.time) / _SPEED
    duration = float(shown[-1]) + _PAUSE
    views = ArenaView(config, end, fields_of_view), MapView(config, end, fusion.classes)
    height = _TOP + SIZE + _LINE * max(2, len(config.carried)) + 16
    root = Element("svg", {"xmlns": "http://www.w3.org/2000/svg", "class": "film", "role": "img"})
    root.set("viewBox", f"0 0 {WIDTH} {height}")
    root.set("aria-labelledby", "title")
    robots = " and ".join(dict.fromkeys(config.carried))
    text = (
        f"{title}: robots with {robots} look at {config.arena.num_pois} points of interest; the "
        f"ellipses of the shared map shrink. It ends after {seconds:.1f} s."
    )
    add(root, "title", text, id="title")
    add(root, "style", _STYLE)
    clip = add(add(root, "defs"), "clipPath", id="view")
    add(clip, "rect", width=SIZE, height=SIZE, rx=6)
    add(root, "rect", class_="film-paper", width=WIDTH, height=height)
    # Where motion is unwelcome the last frame is shown alone.
    for moves in (True, False):
        timeline = Timeline(shown / duration, duration, moves)
        part = add(root, "g", class_="film-moving" if moves else "film-still")
        _draw(part, timeline, config, record, views, (title, seconds))
    return ElementTree.tostring(root, encoding="unicode") + "\n"


def _frames(config: Config, records: Record, prior: Belief, steps: int) -> tuple[Record, float]:
    """The frames from just before a mission until shortly after its end, and its length in s."""
    period = config.mission.control_period
    rows = np.minimum(np.arange(-1, steps + _AFTER).clip(0), len(records.time) - 1)
    record: Record = jax.tree.map(lambda x: np.array(np.asarray(x)[rows]), records)
    record.time[:] = period * np.arange(len(rows))
    record.seen[0], record.scanned[0], record.detected[0] = False, False, False
    record.phase[0], record.target[0] = 0, config.arena.num_pois
    record.belief.mean[0], record.belief.std[0] = prior.mean, prior.std
    return record, steps * period


def _draw(
    parent: Element,
    timeline: Timeline,
    config: Config,
    record: Record,
    views: tuple[ArenaView, MapView],
    heading: tuple[str, float],
) -> None:
    """Draws everything that moves, or the last frame."""
    title, seconds = heading
    for i, (view, name) in enumerate(zip(views, (title, "the shared map"), strict=True)):
        half = add(parent, "g", transform=f"translate({10 + i * (SIZE + 20)} 0)")
        add(half, "text", name, y=25, class_="film-title")
        place = add(half, "g", transform=f"translate(0 {_TOP})")
        add(place, "rect", class_="film-floor", width=SIZE, height=SIZE, rx=6)
        view.draw(add(place, "g", clip_path="url(#view)"), timeline, record)
        if i == 0:
            clock = [f"{min(t, seconds):.0f} s" for t in np.floor(record.time)]
            clock[-1] = f"{seconds:.1f} s"
            _strip(half, timeline, clock, SIZE, 25, "film-title film-end")
            for r, named in enumerate(config.robot_names):
                robot = named.replace("_", " ")
                y = _TOP + SIZE + 24 + _LINE * r
                colour = modality_colour(config.modality_of_robot[r])
                add(half, "circle", cx=8, cy=y - 6, r=7, fill=colour)
                doing = [
                    f"{robot}: {_doing(int(phase), int(target), config.arena.num_pois)}"
                    for phase, target in zip(record.phase[:, r], record.target[:, r], strict=True)
                ]
                _strip(half, timeline, doing, 24, y, "film-line")
        else:
            y = _TOP + SIZE + 24
            add(half, "text", "The belief in each numbered PoI:", y=y, class_="film-line")
            add(
                half,
                "text",
                "1-sigma ellipse; dotted: not seen yet",
                y=y + _LINE,
                class_="film-line",
            )


def _strip(
    parent: Element, timeline: Timeline, texts: list[str], x: float, y: float, class_: str
) -> None:
    """Draws a text that changes, `texts` frame by frame."""
    for text in dict.fromkeys(texts):
        element = add(parent, "text", text, x=x, y=y, class_=class_)
        timeline.animate(element, "opacity", [float(t == text) for t in texts], jumps=True)


def _doing(phase: int, target: int, num_pois: int) -> str:
    """A robot's phase in words."""
    has_target = 1 <= phase <= 3 and target < num_pois
    return f"{_PHASES[phase]} {target + 1}" if has_target else _PHASES[phase]
