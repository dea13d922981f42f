"""Which of many missions are recorded, and their recordings."""

import jax
import numpy as np
from jaxtyping import Int

from jaxsense.core.types import pytree
from jaxsense.mission import MissionState, Record
from jaxsense.run import devices

AT_A_TIME = 2
"""Missions recorded at a time on each device, in its first slots."""


@pytree
class Recording:
    """A whole mission.

    Attributes:
      end: its last state.
      records: `[steps]` records of all control periods; after the end, the last one repeats.
    """

    end: MissionState
    records: Record


class Films:
    """Records the first mission, and another one if both begin together."""

    def __init__(self, second: int | None):
        """Begins without recordings.

        Args:
          second: the other mission; None for no other.
        """
        self._wanted = (0,) if second is None else (0, second)
        self._chunks = [list[Recording]() for _ in self._wanted]

    def order(self, total: int, stride: int) -> Int[np.ndarray, " E"]:
        """All missions, so that those to record begin in the first slots.

        Args:
          total: number of missions.
          stride: in a list of every `stride`-th mission, those to record come first.
        """
        missions = np.arange(total, dtype=np.int32)
        for i, mission in enumerate(self._wanted):
            if i * stride < total:
                missions[[i * stride, mission]] = missions[[mission, i * stride]]
        return missions

    def record(self, playing: Int[np.ndarray, " B"], first: Recording) -> None:
        """Keeps a chunk of the missions to record, until their ends.

        Args:
          playing: the mission in each slot.
          first: `[K]` the missions in the first slots of each device.
        """
        slots = range(min(len(self._wanted), len(first.end.done)))
        if due := [i for i in slots if playing[i] == self._wanted[i]]:
            fetched = devices.fetched(first)
            for i in due:
                chunk = jax.tree.map(lambda x: np.array(x[i]), fetched)  # noqa: B023
                self._chunks[i].append(chunk)

    def recordings(self) -> list[Recording]:
        """The recordings of the missions that were recorded, the first one first."""
        return [_whole(chunks) for chunks in self._chunks if chunks]


def _whole(chunks: list[Recording]) -> Recording:
    """A recording from its chunks."""
    records = [each.records for each in chunks]
    return Recording(chunks[-1].end, jax.tree.map(lambda *x: np.concatenate(x), *records))
