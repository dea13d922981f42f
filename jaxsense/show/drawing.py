"""Figures as files, and names next to what they name.

SVG files follow the colour scheme of the page that shows them: each colour has a counterpart on a
dark page. What is black or white in a figure becomes the ink and the paper of `style.css`.
"""

import io
import re
from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_hex, to_rgb
from matplotlib.figure import Figure
from matplotlib.text import Annotation

from jaxsense.show.colours import ON_DARK, RGB

_PAPER, _INK = "#16181d", "#e6e8ec"  # of a dark page, as in `style.css`
_LEAST_CONTRAST = 4.0  # of a colour with dark paper
_GREY = 0.1  # most difference between the parts of a colour without a hue
_FONT = 'system-ui,-apple-system,"Segoe UI",Roboto,sans-serif'
_GAP = 1.25  # lines of text, between the names next to an axis
_INCH = 72.0  # points


def encoded(figure: Figure, path: Path) -> bytes:
    """A figure as an SVG file if the path ends in `.svg`, else as a PNG file.

    Args:
      figure: to encode.
      path: of the file to write.
    """
    if path.suffix == ".svg":
        return svg(figure)
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=120)
    return content.getvalue()


def svg(figure: Figure) -> bytes:
    """A figure as an SVG file, the same for the same figure, that is dark on a dark page."""
    content = io.StringIO()
    # Texts remain texts, and names of parts do not depend on chance.
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": "jaxsense"}):
        figure.savefig(content, format="svg", metadata={"Date": None})
    text = re.sub(r' d="[^"]*"', _rounded, content.getvalue())
    text = re.sub(r"'DejaVu Sans'[^;\"]*", "sans-serif", text)  # and what may take its place
    return re.sub(r"(<svg [^>]*>)", lambda tag: tag[1] + _style(text), text, count=1).encode()


def _rounded(path: re.Match[str]) -> str:
    """A path to a hundredth of a point."""
    return re.sub(r"(\.\d\d)\d+", r"\1", path[0])


def _style(text: str) -> str:
    """The style sheet that makes an SVG file dark where the page is."""
    used = sorted(set(re.findall(r"\b(fill|stroke): (#[0-9a-f]{6})", text)))
    # Matplotlib leaves out the fill that is black.
    rules = [f"svg{{fill:{_INK}}}"]
    rules += [
        f'[style*="{part}: {colour}"]{{{part}:{on_dark(colour)}!important}}'
        for part, colour in used
    ]
    return (
        f"<style>text{{font-family:{_FONT}!important}}"
        f"@media (prefers-color-scheme:dark){{{''.join(rules)}}}</style>"
    )


def on_dark(colour: str) -> str:
    """The counterpart of a colour on a dark page, as `#rrggbb`.

    Greys from white to black become those from dark paper to light ink. Colours of policies have
    counterparts of their own. Other colours become lighter until they stand out.

    Args:
      colour: any that matplotlib knows.
    """
    rgb = to_rgb(colour)
    if to_hex(rgb) in ON_DARK:
        return ON_DARK[to_hex(rgb)]
    if max(rgb) - min(rgb) < _GREY:
        return to_hex(_mixed(to_rgb(_INK), to_rgb(_PAPER), float(np.mean(rgb))))
    shades = [_mixed(rgb, (1.0, 1.0, 1.0), share) for share in np.linspace(0, 1, 21)]
    paper = _luminance(to_rgb(_PAPER))
    return to_hex(
        next(s for s in shades if _luminance(s) + 0.05 >= _LEAST_CONTRAST * (paper + 0.05))
    )


def _mixed(one: RGB, other: RGB, share: float) -> RGB:
    red, green, blue = ((1 - share) * a + share * b for a, b in zip(one, other, strict=True))
    return red, green, blue


def _luminance(colour: RGB) -> float:
    """Relative luminance (WCAG 2.2)."""
    parts = (c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in colour)
    return float(np.dot((0.2126, 0.7152, 0.0722), [*parts]))


def name_ends(
    ax: Axes, names: Sequence[tuple[str, float, str]], size: float = 9.0
) -> list[Annotation]:
    """Writes names to the right of an axis, at their heights or as close as there is room.

    Call this when the limits of the axis are final.

    Args:
      ax: linear in y.
      names: text, height in data and colour of each.
      size: of the text, in points.
    """
    ordered = sorted(names, key=lambda name: name[1])
    height = _INCH * ax.bbox.height / ax.figure.dpi
    low, high = ax.get_ylim()
    wanted = np.clip([(y - low) / (high - low) for _, y, _ in ordered], 0.0, 1.0)
    heights = spread(wanted, min(_GAP * size / height, 1 / max(len(ordered) - 1, 1)))
    return [
        ax.annotate(
            text,
            (1.0, place),
            (4, 0),
            xycoords="axes fraction",
            textcoords="offset points",
            color=colour,
            fontsize=size,
            va="center",
            annotation_clip=False,
        )
        for (text, _, colour), place in zip(ordered, heights, strict=True)
    ]


def spread(heights: np.ndarray, gap: float) -> np.ndarray:
    """Heights in [0, 1] at least a gap apart, in the same order and as close to the given ones.

    Args:
      heights: `[K]` increasing.
      gap: at most 1 / (K - 1).
    """
    steps = gap * np.arange(len(heights))
    # Without the gaps the heights must only increase: the nearest such means are those of runs.
    runs: list[tuple[float, int]] = []
    for height in heights - steps:
        total, number = float(height), 1
        while runs and runs[-1][0] / runs[-1][1] >= total / number:
            before, of_before = runs.pop()
            total, number = total + before, number + of_before
        runs.append((total, number))
    found = np.concatenate([np.full(n, total / n) for total, n in runs]) if runs else heights
    last = steps[-1] if len(steps) else 0.0
    return np.clip(found, 0.0, 1.0 - last) + steps
