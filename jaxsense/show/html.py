"""Pages that need no other file, from the templates in this directory."""

import base64
import dataclasses
import re
from collections.abc import Mapping

import jinja2

from jaxsense.config.options import command

_SIZE = re.compile(r'viewBox="0 0 ([1-9]\d*) ([1-9]\d*)"')


@dataclasses.dataclass(frozen=True)
class Films:
    """Films that play together on a page.

    Attributes:
      names: of their files, without suffixes.
      document: page of their own, for a frame without rights.
      tall: height of a half of a film relative to its width.
    """

    names: tuple[str, ...]
    document: str
    tall: float


def films(contents: Mapping[str, str]) -> Films:
    """Films for a page.

    Args:
      contents: of their files, by the names of these without suffixes.
    """
    sizes = [_SIZE.search(content) for content in contents.values()]
    tall = max((int(size[2]) / (int(size[1]) / 2) for size in sizes if size), default=1.0)
    return Films(tuple(contents), render("films.html.jinja", films=contents), tall)


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
