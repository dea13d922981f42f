"""Elements of an SVG, and how they change while it plays (SMIL)."""

import dataclasses
import re
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import ArrayLike

SIZE = 340
"""Side of a view, in px."""
_SMOOTHING = 8  # frames in which a shape comes to its new form


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

    Attributes:
      moments: `[F]` as shares of the duration, increasing from 0; the last frame stays to the end.
      duration: of the animation, in seconds; it then repeats.
      moves: whether the animation plays; otherwise it shows only the last frame.
    """

    moments: np.ndarray
    duration: float
    moves: bool = True

    def animate(
        self, element: Element, attribute: str, values: ArrayLike, *, jumps: bool = False
    ) -> None:
        """Animates an attribute through its values; without animation, sets the last.

        Args:
          element: whose attribute changes.
          attribute: its name, or `translate` or `rotate` for a transformation.
          values: `[F]` numbers or texts, degrees for `rotate`, `[F, 2]` for `translate`.
          jumps: whether it jumps from value to value.
        """
        rows = np.asarray(values).tolist()
        texts = [" ".join(map(_text, row)) if isinstance(row, list) else _text(row) for row in rows]
        self._animate(element, attribute, texts, "discrete" if jumps else "linear")

    def _animate(self, element: Element, attribute: str, values: list[str], mode: str) -> None:
        is_transform = attribute in ("translate", "rotate")
        last = f"{attribute}({values[-1]})" if is_transform else values[-1]
        element.set("transform" if is_transform else attribute, last)
        if not self.moves or len(set(values)) == 1:
            return
        kept = _turning_points(values, both_ends=mode == "linear")
        times = [f"{self.moments[i]:.4f}".rstrip("0").rstrip(".") for i in kept]
        shown = [values[i] for i in kept]
        if mode == "linear" and times[-1] != "1":
            times, shown = [*times, "1"], [*shown, shown[-1]]
        more = {"type": attribute} if is_transform else {}
        add(
            element,
            "animateTransform" if is_transform else "animate",
            attributeName="transform" if is_transform else attribute,
            values=";".join(shown),
            keyTimes=";".join(times),
            calcMode=mode,
            dur=f"{self.duration:.2f}s",
            repeatCount="3",
            **more,
        )


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


def still(film: bytes) -> bytes:
    """The last frame of a film: what is left of it without animations.

    Args:
      film: content of its file.
    """
    return re.sub(rb"<animate[^<>]*>", b"", film)


def smooth(values: np.ndarray) -> np.ndarray:
    """`[F, K]` with each jump as a short way."""
    before = np.repeat(values[:1], _SMOOTHING - 1, axis=0)
    windows = np.lib.stride_tricks.sliding_window_view(
        np.concatenate([before, values]), _SMOOTHING, axis=0
    )
    return windows.mean(axis=-1)


def _turning_points(values: list[str], *, both_ends: bool) -> list[int]:
    """Frames in which the value changes and, with `both_ends`, those before a change."""
    last = len(values) - 1
    return [
        i
        for i, value in enumerate(values)
        if i == 0 or value != values[i - 1] or (both_ends and (i == last or value != values[i + 1]))
    ]
