"""The right half of the picture: the shared map."""

import itertools
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import ArrayLike

from jaxsense.config import Config
from jaxsense.core.types import Fusion
from jaxsense.mission import MissionState, Record
from jaxsense.show.animation.svg import SIZE, Timeline, add, smooth, strip
from jaxsense.show.colours import as_hex, class_colour, in_plane, plane

_CERTAIN = 0.9  # probability of a class from which on a PoI stands at its name
_MOST_ABREAST, _MOST_LISTED = 4, 5  # numbers, of PoIs at one place and in a line of a list
_LETTER, _NEXT_LINE = 3.9, 16.0  # px, of a label: half a letter, and from line to line


class MapView:
    """The latent space: the classes, and the belief of every PoI."""

    def __init__(
        self, config: Config, end: MissionState, fusion: Fusion, probabilities: np.ndarray
    ):
        """Prepares the view.

        Args:
          config: all settings.
          end: the state in which the mission ended.
          fusion: of the map.
          probabilities: `[F, N, C]` of the classes, in the map.
        """
        self._config, self._end = config, end
        self._probabilities, self._prior = probabilities, fusion.prior
        self._plane = plane(np.asarray(fusion.classes.mean))
        self._means, self._stds = map(self._in_plane, (fusion.classes.mean, fusion.classes.std))
        self._scale = SIZE / 2 / (1.0 + float(np.max(np.abs(self._means) + self._stds)))

    def _in_plane(self, values: ArrayLike) -> np.ndarray:
        """`[..., D]` as `[..., 2]`, in the dimensions that are shown."""
        return in_plane(values, self._plane)

    def draw(self, parent: Element, timeline: Timeline, record: Record) -> None:
        """Adds the view.

        Args:
          parent: group whose origin is the view's upper left corner.
          timeline: when the frames are shown.
          record: `[F]` frames of the mission.
        """
        arena = self._config.arena
        colours = [as_hex(class_colour(arena, label)) for label in arena.classes]
        for colour, mean in zip(colours, self._means, strict=True):
            x, y = self._place(mean)
            add(parent, "circle", cx=x, cy=y, r=3, fill=colour)
        is_seen = np.any(record.seen, axis=-1)
        is_certain = is_seen & (self._probabilities.max(axis=-1) >= _CERTAIN)
        self._draw_unknown(parent, timeline, is_seen)
        self._draw_labels(parent, timeline, colours, is_certain, "film-on-floor")
        numbers = add(parent, "g")
        for n in range(arena.num_pois):
            colour = colours[int(self._end.classes[n])]
            mean = self._place(smooth(self._in_plane(record.belief.mean[:, n])))
            radii = smooth(self._radii(record.belief.std[:, n]))
            ellipse = add(parent, "ellipse", fill=colour, stroke=colour, fill_opacity=0.1)
            ellipse.set("stroke-width", "2.5")
            for name, values in zip(("cx", "cy", "rx", "ry"), (*mean.T, *radii.T), strict=True):
                timeline.animate(ellipse, name, values)
            timeline.animate(ellipse, "opacity", is_seen[:, n], jumps=True)
            # Numbers of PoIs at the same place in the map stand side by side.
            number = add(numbers, "g")
            timeline.animate(number, "translate", mean + _beside(n, arena.num_pois))
            is_open = is_seen[:, n] & ~is_certain[:, n]
            text = add(number, "text", str(n + 1), class_="film-number film-on-light", fill=colour)
            timeline.animate(text, "opacity", is_open, jumps=True)
        self._draw_labels(parent, timeline, colours, is_certain, "film-on-light")

    def _draw_unknown(self, parent: Element, timeline: Timeline, is_seen: np.ndarray) -> None:
        """One ring for all PoIs that nobody has seen, `[F, N]`, and their numbers."""
        (x, y), (rx, ry) = (
            self._place(self._in_plane(self._prior.mean)),
            self._radii(self._prior.std),
        )
        ring = add(parent, "ellipse", cx=x, cy=y, rx=rx, ry=ry, fill="none", stroke="#9aa2ad")
        ring.set("stroke-width", "1.5")
        ring.set("stroke-dasharray", "2 5")
        timeline.animate(ring, "opacity", ~is_seen.all(axis=1), jumps=True)
        numbers = [_listed(~seen) for seen in is_seen]
        texts = [f"unknown: {each}" if each else "" for each in numbers]
        style = "film-unknown film-start film-on-floor"
        strip(parent, timeline, texts, x=8, y=18, class_=style)

    def _draw_labels(
        self,
        parent: Element,
        timeline: Timeline,
        colours: list[str],
        is_certain: np.ndarray,
        around: str,
    ) -> None:
        """The classes and, beyond their names, the PoIs that are certain to be of them.

        Drawn below the ellipses they cover the ring, drawn above these they can be read.
        """
        likeliest = self._probabilities.argmax(axis=-1)
        for c, (label, colour) in enumerate(zip(self._config.arena.classes, colours, strict=True)):
            x, y = self._place(self._means[c])
            side = -1 if self._means[c, 1] >= 0 else 1
            y += side * (self._scale * self._stds[c, 1] + 12) + 5
            lists = [_lines(of_class) for of_class in is_certain & (likeliest == c)]
            longest = max(map(len, [label, *itertools.chain(*lists)]))
            half = min(_LETTER * longest, SIZE / 2)
            style = {"x": np.clip(x, half, SIZE - half), "fill": colour}
            style["class_"] = f"film-label {around}"
            add(parent, "text", label, y=y, **style)
            of_line = itertools.zip_longest(*lists, fillvalue="")
            for i, numbers in enumerate(of_line):
                strip(parent, timeline, [*numbers], y=y + side * _NEXT_LINE * (i + 1), **style)

    def _radii(self, std: ArrayLike) -> np.ndarray:
        """`[..., D]` standard deviations in px; before the first look they exceed the view."""
        return np.minimum(self._scale * self._in_plane(std), SIZE / 2 - 5)

    def _place(self, mean: ArrayLike) -> np.ndarray:
        """`[..., 2]` latent, upwards from the middle, in pixels, downwards from the corner."""
        return SIZE / 2 + self._scale * np.asarray(mean) * (1, -1)


def _listed(chosen: np.ndarray) -> str:
    """The numbers of the chosen `[N]` PoIs."""
    return ", ".join(str(n + 1) for n in np.flatnonzero(chosen))


def _lines(chosen: np.ndarray) -> list[str]:
    """The numbers of the chosen `[N]` PoIs, in lines that leave room for other classes."""
    numbers = [str(n + 1) for n in np.flatnonzero(chosen)]
    starts = range(0, len(numbers), _MOST_LISTED)
    return [", ".join(numbers[i : i + _MOST_LISTED]) for i in starts]


def _beside(n: int, num_pois: int) -> np.ndarray:
    """Where the number of a PoI stands from its place in the map: in rows of four at most."""
    columns = min(num_pois, _MOST_ABREAST)
    row, column = divmod(n, columns)
    rows = -(-num_pois // columns)
    width = 14 if num_pois < 10 else 20  # px, of one or two digits
    return np.array([width * (column - (columns - 1) / 2), 15 * (row - (rows - 1) / 2) - 6])
