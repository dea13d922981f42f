"""Embeds an animation in the page: halves side by side, or stacked on a phone."""

import dataclasses
import re
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

from markupsafe import Markup

_NAMESPACE = "http://www.w3.org/2000/svg"
_ATTRIBUTES = {
    *("attributeName", "calcMode", "dur", "keyTimes", "repeatCount", "type", "values"),
    *("aria-labelledby", "class", "clip-path", "id", "role", "transform", "viewBox"),
    *("cx", "cy", "d", "height", "points", "r", "rx", "ry", "width", "x", "x1", "x2"),
    *("y", "y1", "y2", "fill", "fill-opacity", "opacity", "stroke", "stroke-dasharray"),
    *("stroke-dashoffset", "stroke-opacity", "stroke-width"),
}
_ELEMENTS = {
    *("animate", "animateTransform", "circle", "clipPath", "defs", "ellipse", "g", "line"),
    *("path", "polyline", "rect", "style", "svg", "text", "title"),
}


@dataclasses.dataclass(frozen=True)
class Film:
    """Two pictures that move together, as markup.

    Attributes:
      left: the animation, cut to its left half.
      right: its right half, a view of the same elements.
    """

    left: Markup
    right: Markup


def read_film(path: Path) -> Film | None:
    """Reads an animation of `animation.write`; None if a file holds anything else.

    A file from elsewhere must not make the page run or load anything.
    """
    try:
        text = path.read_text(encoding="utf-8")
        # Entities of a document type may expand beyond all memory.
        root = ElementTree.Element("") if "<!" in text else ElementTree.fromstring(text)
        _, _, width, height = (float(part) for part in root.get("viewBox", "").split())
    except (ElementTree.ParseError, ValueError):
        return None
    if not all(map(_is_ours, root.iter())):
        return None
    ElementTree.register_namespace("", _NAMESPACE)
    root.set("viewBox", f"0 0 {width / 2:g} {height:g}")
    right = Markup(
        '<svg class="film" aria-hidden="true" viewBox="{} 0 {} {}"><use href="#{}-film"/></svg>'
    ).format(f"{width / 2:g}", f"{width / 2:g}", f"{height:g}", path.stem)
    return Film(Markup(ElementTree.tostring(root, encoding="unicode")), right)


def _is_ours(element: Element) -> bool:
    """Whether an element is one of `animation.write`, and loads and runs nothing."""
    namespace, _, name = element.tag.removeprefix("{").rpartition("}")
    values = " ".join([*element.attrib.values(), element.text or ""])
    return (
        namespace == _NAMESPACE
        and name in _ELEMENTS
        and set(element.attrib) <= _ATTRIBUTES
        and element.get("attributeName", "x") in _ATTRIBUTES
        # Styles can load too: by `url`, `@import` or an escaped letter.
        and not re.search(r"url\s*\((?!#[\w-]+\))|@import|\\", values, re.IGNORECASE)
    )
