"""The whole picture: both views, what each robot does, and the time."""

from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import jax
import numpy as np

from jaxsense.config import Config
from jaxsense.core.types import Belief
from jaxsense.mission import Record
from jaxsense.run import files
from jaxsense.run.missions import Recording
from jaxsense.show.animation.svg import Timeline, add
from jaxsense.show.animation.views import SIZE, ArenaView, MapView
from jaxsense.show.colours import modality_colour

WIDTH = 2 * SIZE + 40
_SPEED = 2.0  # times real time
_AFTER, _PAUSE = (
    10,
    2.5,
)  # frames shown after the mission's end, and seconds that the last one stays
_TOP, _LINE = 38, 26
_PHASES = ("asks", "drives to", "looks at", "backs off from", "has ended", "has failed")
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


def write(
    path: Path, config: Config, recording: Recording, class_beliefs: Belief, title: str
) -> None:
    """Writes a recorded mission as an animated SVG.

    Args:
      path: file to write; its name, without the suffix, becomes part of the identifiers in it.
      config: all settings.
      recording: the mission, for example `Played.recording`.
      class_beliefs: `[C, D]` beliefs of the classes, to show where they are in the map.
      title: what to call it.

    Raises:
      OSError: if the file cannot be written.
    """
    record, seconds = _frames(config, recording)
    shown = np.asarray(record.time) / _SPEED
    duration = float(shown[-1]) + _PAUSE
    moments = shown / duration
    views = ArenaView(config, recording.end), MapView(config, recording.end, class_beliefs)
    height = _TOP + SIZE + _LINE * max(2, len(config.carried)) + 16
    root = Element(
        "svg",
        {
            "xmlns": "http://www.w3.org/2000/svg",
            "viewBox": f"0 0 {WIDTH} {height}",
            "class": "film",
            "role": "img",
            "aria-labelledby": f"{path.stem}-title",
        },
    )
    robots = " and ".join(dict.fromkeys(config.carried))
    add(
        root,
        "title",
        f"{title}: robots with {robots} look at {config.arena.num_pois} points of interest; the "
        f"ellipses of the shared map shrink. It ends after {seconds:.1f} s.",
        id=f"{path.stem}-title",
    )
    add(root, "style", _STYLE)
    clip = add(add(root, "defs"), "clipPath", id=f"{path.stem}-view")
    add(clip, "rect", width=SIZE, height=SIZE, rx=6)
    film = add(root, "g", id=f"{path.stem}-film")
    add(film, "rect", class_="film-paper", width=WIDTH, height=height)
    # Where motion is unwelcome the last frame is shown alone.
    for moves in (True, False):
        timeline = Timeline(moments, duration, moves)
        part = add(film, "g", class_="film-moving" if moves else "film-still")
        _draw(part, timeline, config, record, views, f"{path.stem}-view", (title, seconds))
    files.write(path, ElementTree.tostring(root, encoding="unicode") + "\n")


def _frames(config: Config, recording: Recording) -> tuple[Record, float]:
    """What to show: the moment before the mission, all of it, and a little more; and its length."""
    period, steps = config.mission.control_period, int(recording.end.steps)
    rows = np.minimum(np.arange(-1, steps + _AFTER).clip(0), len(recording.records.time) - 1)
    record: Record = jax.tree.map(lambda x: np.array(np.asarray(x)[rows]), recording.records)
    record.time[:] = period * np.arange(len(rows))
    record.seen[0], record.scanned[0], record.detected[0] = False, False, False
    record.phase[0], record.target[0] = 0, config.arena.num_pois
    record.belief.mean[0] = 0.0
    record.belief.std[0] = np.sqrt(config.mdp.unseen_variance)
    return record, steps * period


def _draw(
    parent: Element,
    timeline: Timeline,
    config: Config,
    record: Record,
    views: tuple[ArenaView, MapView],
    clip: str,
    heading: tuple[str, float],
) -> None:
    """All that moves, or its end."""
    title, seconds = heading
    for i, (view, name) in enumerate(zip(views, (title, "the shared map"), strict=True)):
        half = add(parent, "g", transform=f"translate({10 + i * (SIZE + 20)} 0)")
        add(half, "text", name, y=25, class_="film-title")
        place = add(half, "g", transform=f"translate(0 {_TOP})")
        add(place, "rect", class_="film-floor", width=SIZE, height=SIZE, rx=6)
        view.draw(add(place, "g", clip_path=f"url(#{clip})"), timeline, record)
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
                    f"{robot} {_doing(int(phase), int(target), config.arena.num_pois)}"
                    for phase, target in zip(record.phase[:, r], record.target[:, r], strict=True)
                ]
                _strip(half, timeline, doing, 24, y, "film-line")
        else:
            y = _TOP + SIZE + 24
            add(half, "text", "What is known of each point:", y=y, class_="film-line")
            add(half, "text", "1-sigma ellipses; dotted: not seen", y=y + _LINE, class_="film-line")


def _strip(
    parent: Element, timeline: Timeline, texts: list[str], x: float, y: float, class_: str
) -> None:
    """A text that changes: each is shown in its time."""
    for text in dict.fromkeys(texts):
        element = add(parent, "text", text, x=x, y=y, class_=class_)
        timeline.set(element, "opacity", [float(t == text) for t in texts])


def _doing(phase: int, target: int, num_pois: int) -> str:
    """What a robot is doing, in words."""
    has_target = 1 <= phase <= 3 and target < num_pois
    return f"{_PHASES[phase]} {target + 1}" if has_target else _PHASES[phase]
