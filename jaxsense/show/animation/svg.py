"""Elements of an SVG, and how they change while it plays (CSS animations)."""

import collections
import dataclasses
import hashlib
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import ArrayLike

SIZE = 340
"""Side of a view, in px."""
_SMOOTHING = 8  # frames in which a shape comes to its new form
_TRANSFORMS = ("translate", "rotate")
_UNITS = collections.defaultdict(lambda: "px", opacity="", rotate="deg")
_CLOSE = collections.defaultdict(lambda: 0.1, opacity=0.01, rotate=0.5)
"""How far from its value an attribute may be, in its unit, while it moves."""


def add(parent: Element, tag: str, text: str | None = None, **attributes: ArrayLike) -> Element:
    """Adds an element.

    Args:
      parent: of the element.
      tag: of the element.
      text: in the element.
      **attributes: numbers or texts; `class_` is `class`, and `_` in other names is `-`.
    """
    names = (name.rstrip("_").replace("_", "-") for name in attributes)
    values = (_text(value) for value in attributes.values())
    element = ElementTree.SubElement(parent, tag, dict(zip(names, values, strict=True)))
    element.text = text
    return element


def _text(value: ArrayLike) -> str:
    """Numbers to a hundredth of a pixel."""
    return value if isinstance(value, str) else f"{round(float(np.asarray(value)), 2):g}"


@dataclasses.dataclass(frozen=True)
class Timeline:
    """When each frame is shown.

    Elements hold what the last frame shows, and key frames what came before it. Whoever switches
    animations off therefore sees the last frame.

    Attributes:
      moments: `[F]` as shares of the duration, increasing from 0; the last frame stays to the end.
      sheet: `style` element for the key frames. The variable `--film` of the picture says how long
        and how often they are played.
    """

    moments: np.ndarray
    sheet: Element

    def animate(
        self, element: Element, attribute: str, values: ArrayLike, *, jumps: bool = False
    ) -> None:
        """Animates an attribute through its values.

        Args:
          element: whose attribute changes.
          attribute: its name, or `translate` or `rotate` for a transformation.
          values: `[F]` numbers, degrees for `rotate`, `[F, 2]` for `translate`.
          jumps: whether it jumps from value to value.
        """
        rows = np.asarray(values, float).reshape(len(self.moments), -1)
        if attribute in _TRANSFORMS:
            element.set("transform", f"{attribute}({_list(rows[-1])})")
        else:
            element.set(attribute, _list(rows[-1]))
        kept = _changes(rows) if jumps else _corners(self.moments, rows, _CLOSE[attribute])
        if (rows[kept] == rows[-1]).all():
            return
        frames = "".join(f"{_percent(self.moments[i])}{_rule(attribute, rows[i])}" for i in kept)
        if not jumps:
            frames += f"100%{_rule(attribute, rows[-1])}"
        # Named after what they hold, so that films can share a page.
        name = f"k{hashlib.blake2b(frames.encode(), digest_size=5).hexdigest()}"
        rule = f"@keyframes {name}{{{frames}}}\n"
        if rule not in str(self.sheet.text):
            self.sheet.text = f"{self.sheet.text or ''}{rule}"
        before = element.get("style")
        play = f"{name} {'step-end' if jumps else 'linear'} var(--film)"
        element.set("style", f"{before},{play}" if before else f"animation:{play}")


def strip(parent: Element, timeline: Timeline, texts: list[str], **attributes: ArrayLike) -> None:
    """Draws a text that changes.

    Args:
      parent: of the elements.
      timeline: when the frames are shown.
      texts: `[F]` the text of each frame; none is drawn for an empty one.
      **attributes: see `add`.
    """
    for text in filter(None, dict.fromkeys(texts)):
        element = add(parent, "text", text, **attributes)
        timeline.animate(element, "opacity", [float(t == text) for t in texts], jumps=True)


def smooth(values: np.ndarray) -> np.ndarray:
    """`[F, K]` with each jump as a short way."""
    before = np.repeat(values[:1], _SMOOTHING - 1, axis=0)
    windows = np.lib.stride_tricks.sliding_window_view(
        np.concatenate([before, values]), _SMOOTHING, axis=0
    )
    return windows.mean(axis=-1)


def _list(row: np.ndarray, unit: str = "", between: str = " ") -> str:
    return between.join(f"{_text(value)}{unit}" for value in row)


def _rule(attribute: str, row: np.ndarray) -> str:
    """What an attribute is, in CSS."""
    value = _list(row, _UNITS[attribute], ",")
    if attribute in _TRANSFORMS:
        return f"{{transform:{attribute}({value})}}"
    return f"{{{attribute}:{value}}}"


def _percent(share: float) -> str:
    return f"{round(100 * float(share), 2):g}%"


def _changes(rows: np.ndarray) -> list[int]:
    """Frames in which the `[F, K]` values change, the first included."""
    is_new = (rows[1:] != rows[:-1]).any(axis=1)
    return [0, *(1 + np.flatnonzero(is_new)).tolist()]


def _corners(moments: np.ndarray, rows: np.ndarray, close: float) -> list[int]:
    """Frames between which straight lines come `close` to all `[F, K]` values.

    The first and the last frame, and then, where a line is too far off, the frame that is furthest
    from it (Ramer 1972, Douglas and Peucker 1973).
    """
    kept, spans = [len(rows) - 1], [(0, len(rows) - 1)]
    while spans:
        first, last = spans.pop()
        span = slice(first, last + 1)
        share = (moments[span] - moments[first]) / (moments[last] - moments[first])
        line = rows[first] + share[:, None] * (rows[last] - rows[first])
        off = np.abs(rows[span] - line).max(axis=1)
        furthest = first + int(off.argmax())
        if off.max() > close:
            spans += [(first, furthest), (furthest, last)]
        else:
            kept.append(first)
    return sorted(kept)
