"""Pages that need no other file, from the templates in this directory."""

import base64
import dataclasses
import re
from collections.abc import Mapping
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import jinja2
from markupsafe import Markup

from jaxsense.config.options import command

_SVG = "{http://www.w3.org/2000/svg}"
_TAG = re.compile(
    "circle|clipPath|defs|ellipse|g|line|path|polyline|rect|style|svg|text|title"
).fullmatch
_ATTRIBUTE = re.compile(
    "class|clip-path|c?x|c?y|d|(fill|stroke)?-?opacity|fill|height|id|points|r|role|rx|ry|"
    "stroke(-dasharray|-dashoffset|-width)?|style|transform|viewBox|width|[xy][12]"
).fullmatch
_VALUE = re.compile(
    r"(?s:(?!.*url\()(?!.*:)[^<>]*)|url\(#view\)|--film:[\d.]+s \d+|animation:[\w .,()-]*"
).fullmatch
_KEY_FRAMES = re.compile(r"@keyframes k[0-9a-f]{10}\{(?:[\d.]+%\{[a-z-]+:[\w.,()-]*\})*\}\n?")


@dataclasses.dataclass(frozen=True)
class Films:
    """Films that play together on a page.

    Attributes:
      names: of their files, without suffixes.
      drawings: SVG elements, of a film's own kinds alone.
    """

    names: tuple[str, ...]
    drawings: tuple[Markup, ...]


def films(contents: Mapping[str, str]) -> Films:
    """Films for a page.

    Args:
      contents: of their files, by the names of these without suffixes. What no film draws is left
        out: a file may come from anywhere.
    """
    return Films(tuple(contents), tuple(map(_drawing, contents.values())))


def _drawing(content: str) -> Markup:
    """The elements, attributes and key frames of a film; nothing if the file is no SVG."""
    try:
        root = ElementTree.fromstring(content)
        copy = _copied(root)
    except (ElementTree.ParseError, RecursionError):
        return Markup()
    is_svg = root.tag == f"{_SVG}svg"
    return Markup(ElementTree.tostring(copy, encoding="unicode")) if is_svg else Markup()


def _copied(element: Element) -> Element:
    """A copy of what films are made of, without the namespace, which HTML knows."""
    kept = {name: x for name, x in element.attrib.items() if _ATTRIBUTE(name) and _VALUE(x)}
    copy = Element(element.tag.removeprefix(_SVG), kept)
    is_sheet = copy.tag == "style"
    copy.text = "".join(_KEY_FRAMES.findall(element.text or "")) if is_sheet else element.text
    copy.extend([_copied(child) for child in element if _TAG(child.tag.removeprefix(_SVG))])
    return copy


def render(template: str, **values: object) -> str:
    """Fills a template.

    Args:
      template: name of its file.
      **values: what it shows; text is escaped.
    """
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("jaxsense.show", "."),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    return environment.get_template(template).render(command=command, **values)


def picture(content: bytes) -> str:
    """An SVG as the source of an `img`, in which browsers run no scripts and load no files."""
    return f"data:image/svg+xml;base64,{base64.b64encode(content).decode()}"
