"""An animation inside the page: its halves side by side, or one above the other on a phone."""

import dataclasses
from pathlib import Path
from xml.etree import ElementTree

_NAMESPACE = "http://www.w3.org/2000/svg"


@dataclasses.dataclass(frozen=True)
class Film:
    """Two pictures that move together, as markup.

    Attributes:
      left: the animation, cut to its left half.
      right: its right half, which repeats what the left one shows.
    """

    left: str
    right: str


def read_film(path: Path) -> Film:
    """Reads what `animation.write` has written."""
    ElementTree.register_namespace("", _NAMESPACE)
    root = ElementTree.fromstring(path.read_text(encoding="utf-8"))
    _, _, width, height = (float(part) for part in root.get("viewBox", "").split())
    root.set("viewBox", f"0 0 {width / 2:g} {height:g}")
    left = ElementTree.tostring(root, encoding="unicode")
    right = (
        f'<svg class="film" aria-hidden="true" '
        f'viewBox="{width / 2:g} 0 {width / 2:g} {height:g}">'
        f'<use href="#{path.stem}-film"/></svg>'
    )
    return Film(left, right)
