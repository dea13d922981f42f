"""Which missions wait, play and are done, in the slots of a batch."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Int


class Ledger:
    """Assigns missions to the P x S slots of a batch, whose P parts lie on devices of their own.

    A mission that is done makes room for the next one. The next ones come from a reserve of P x S
    missions that have begun; each part takes its own in order.
    """

    def __init__(self, waiting: Sequence[Int[np.ndarray, " _"]], slots: int):
        """Lets all missions wait.

        Args:
          waiting: for each of the P parts, its missions in order.
          slots: S, number of slots of each part.
        """
        self._missions, self._slots = waiting, slots
        self._playing = np.full((len(waiting), slots), -1)
        self._given = np.zeros(len(waiting), np.int32)  # how many have left the reserve
        self._reserved_from = np.full(len(waiting), -slots)
        self._left = sum(map(len, waiting))

    @property
    def is_over(self) -> bool:
        """Whether all missions are done."""
        return self._left == 0

    @property
    def needs_reserve(self) -> bool:
        """Whether missions wait in a part whose reserve is used up."""
        waits = self._given < [*map(len, self._missions)]
        return bool(np.any(waits & (self._given == self._reserved_from + self._slots)))

    def reserve(self) -> Int[np.ndarray, " B"]:
        """Begins a new reserve.

        Returns:
          `[P * S]` the missions to begin. Where a part has fewer, one repeats, which no slot takes.
        """
        self._reserved_from = self._given.copy()
        rows = np.zeros_like(self._playing, np.int32)
        for part, (missions, given) in enumerate(zip(self._missions, self._given, strict=True)):
            some = missions[given : given + self._slots]
            rows[part, : len(some)] = some
        return rows.reshape(-1)

    def fill(self) -> Int[np.ndarray, " B"]:
        """Gives idle slots to missions of the reserve.

        Returns:
          `[P * S]` index of the mission that each slot takes, within the reserve of its part; -1 if
          the slot keeps its own.
        """
        taken = np.full_like(self._playing, -1, np.int32)
        for part, missions in enumerate(self._missions):
            given, first = self._given[part], self._reserved_from[part]
            idle = np.flatnonzero(self._playing[part] < 0)
            idle = idle[: min(first + self._slots, len(missions)) - given]
            following = given + np.arange(len(idle))
            taken[part, idle] = following - first
            self._playing[part, idle] = missions[following]
            self._given[part] += len(idle)
        return taken.reshape(-1)

    @property
    def playing(self) -> Int[np.ndarray, " B"]:
        """`[P * S]` mission in each slot; -1 in idle ones."""
        return self._playing.reshape(-1)

    def end(self, done: Bool[np.ndarray, " B"]) -> Int[np.ndarray, " _"]:
        """Ends missions.

        Args:
          done: `[P * S]` whether the mission of each slot is done; idle ones do not count.

        Returns:
          The slots that are idle from now on.
        """
        slots = np.flatnonzero(done & (self.playing >= 0))
        self._playing.reshape(-1)[slots] = -1
        self._left -= len(slots)
        return slots
