"""Draws pictures while a run does something else."""

from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor, wait
from pathlib import Path
from typing import TypeAlias

Pictures: TypeAlias = Mapping[str, bytes | str]
"""The content of plots and films, by the names of their files."""


class Artist:
    """Draws in one thread of its own, because matplotlib does not work in several at once."""

    def __init__(self):
        """Begins without pictures."""
        self._thread = ThreadPoolExecutor(1, "draw")
        self._drawn: list[tuple[Path, Future[Pictures]]] = []

    def __enter__(self) -> "Artist":
        return self

    def __exit__(self, *_: object) -> None:
        """Draws nothing more."""
        self._thread.shutdown(wait=False, cancel_futures=True)

    def draw(self, path: Path, draw: Callable[[], Pictures]) -> None:
        """Starts to draw some pictures.

        Args:
          path: where they belong.
          draw: returns them.
        """
        self._drawn.append((path, self._thread.submit(draw)))

    def finished(self) -> dict[Path, Pictures]:
        """Waits for all pictures; returns them by where they belong, or raises what failed."""
        futures = [future for _, future in self._drawn]
        # A wait without timeout may not notice Ctrl-C.
        while wait(futures, timeout=0.2).not_done:
            pass
        found: dict[Path, Pictures] = {}
        for path, future in self._drawn:
            found[path] = {**found.get(path, {}), **future.result()}
        return found
