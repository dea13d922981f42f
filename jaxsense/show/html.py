"""Pages that need no other file, from the templates in this directory."""

import base64
import dataclasses
import re
from collections.abc import Mapping

import jinja2

from jaxsense.config.options import command

_KINDS = {"svg": "svg+xml", "png": "png"}
_SMIL = re.compile(r"<animate[^<>]*>")
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
    # Films of earlier versions (SMIL) cannot be paused: what is left is their last frame.
    contents = {name: _SMIL.sub("", content) for name, content in contents.items()}
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


def picture(kind: str, content: bytes) -> str:
    """A picture as the source of an `img`, in which browsers run no scripts and load no files.

    Args:
      kind: `svg` or `png`.
      content: of its file.
    """
    return f"data:image/{_KINDS[kind]};base64,{base64.b64encode(content).decode()}"
