"""Pages that need no other file, from the templates in this directory."""

import base64
import dataclasses

import jinja2

from jaxsense.config.options import command
from jaxsense.show import animation

_KINDS = {"svg": "svg+xml", "png": "png"}


@dataclasses.dataclass(frozen=True)
class Film:
    """A film on a page.

    Attributes:
      name: of its file, without a suffix.
      plays: source of an `img` that plays.
      stopped: source of an `img` with the last frame.
    """

    name: str
    plays: str
    stopped: str


def film(name: str, content: bytes) -> Film:
    """A film for a page.

    Args:
      name: of its file, without a suffix.
      content: of its file.
    """
    return Film(name, picture("svg", content), picture("svg", animation.still(content)))


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
