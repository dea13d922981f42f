"""Elements of an SVG, and how they change while it plays (CSS animations)."""

import collections
import dataclasses
import hashlib
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import ArrayLike

_SMOOTHING = 8  # frames in which a shape comes to its new form
_TRANSFORMS = ("translate", "rotate")
_UNITS = collections.defaultdict(lambda: "px", opacity="", rotate="deg")
_CLOSE = collections.defaultdict(lambda: 0.1, opacity=0.01, rotate=0.5)
"""How far from its value an attribute may be, in its unit, while it moves."""


def add(parent: Element, tag: str, text: str | None = None, **attributes: ArrayLike) -> Element:
    """Adds an element; in names of attributes, `class_` is `class` and `_` elsewhere is `-`."""
    given = {name.rstrip("_").replace("_", "-"): _text(x) for name, x in attributes.items()}
    element = ElementTree.SubElement(parent, tag, given)
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
        is_transform = attribute in _TRANSFORMS
        last = " ".join(map(_text, rows[-1]))
        element.set(
            "transform" if is_transform else attribute,
            f"{attribute}({last})" if is_transform else last,
        )
        is_new = np.append(True, (rows[1:] != rows[:-1]).any(axis=1))
        close = _CLOSE[attribute]
        kept = np.flatnonzero(is_new) if jumps else _corners(self.moments, rows, close)
        if (rows[kept] == rows[-1]).all():
            return
        ends = [] if jumps else [(1.0, rows[-1])]  # the last frame stays
        frames = "".join(
            f"{_text(100 * share)}%{_rule(attribute, row)}"
            for share, row in [*zip(self.moments[kept], rows[kept], strict=True), *ends]
        )
        # Named after what they hold, so that films can share a page.
        name = f"k{hashlib.blake2b(frames.encode(), digest_size=5).hexdigest()}"
        rule = f"@keyframes {name}{{{frames}}}\n"
        if rule not in str(self.sheet.text):
            self.sheet.text = f"{self.sheet.text or ''}{rule}"
        before = element.get("style")
        play = f"{name} {'step-end' if jumps else 'linear'} var(--film)"
        element.set("style", f"{before},{play}" if before else f"animation:{play}")

    def strip(self, parent: Element, texts: list[str], **attributes: ArrayLike) -> None:
        """Draws the `[F]` texts of the frames in one place; none for an empty one."""
        for text in filter(None, dict.fromkeys(texts)):
            element = add(parent, "text", text, **attributes)
            self.animate(element, "opacity", [t == text for t in texts], jumps=True)


def smooth(values: np.ndarray) -> np.ndarray:
    """`[F, K]` with each jump as a short way."""
    before = np.repeat(values[:1], _SMOOTHING - 1, axis=0)
    windows = np.lib.stride_tricks.sliding_window_view(
        np.concatenate([before, values]), _SMOOTHING, axis=0
    )
    return windows.mean(axis=-1)


def _rule(attribute: str, row: np.ndarray) -> str:
    """What an attribute is, in CSS."""
    value = ",".join(f"{_text(each)}{_UNITS[attribute]}" for each in row)
    if attribute in _TRANSFORMS:
        return f"{{transform:{attribute}({value})}}"
    return f"{{{attribute}:{value}}}"


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
