"""Which of many missions play at once: the size of their batch and chunks, and its slots."""

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Int

from jaxsense.config import Config
from jaxsense.config.mission import CONTROL_PERIOD, NODES_PER_POI, VIEW_SIDES
from jaxsense.mission.maps import MOST_LOOKS
from jaxsense.mission.roadmap import VIEW_DISTANCES
from jaxsense.run import devices
from jaxsense.run.devices import ALONE, Workers

CHUNK = math.ceil(2.5 / CONTROL_PERIOD)
"""Control periods between two reports."""
# Missions side by side on each thread of a CPU or on each accelerator.
_LEAST_OF_CPU, _MOST_OF_CPU, _CACHE = 8, 192, 2**26  # bytes
_MOST_OF_ACCELERATOR, _SHARE_OF_MEMORY = 32768, 0.05
# A control step of so many missions takes an accelerator twice as long as that of a few. With T
# missions, B of which play at once, the time is about (T / B + 1) * (1 + B / this): B squared is
# this times T at its minimum.
_AS_LONG_AS_NONE = 8192
_MANY_POIS = 2**14  # of all missions; on a CPU, one takes some 3 ms of a core


def batch_of(config: Config, total: int, workers: Workers = ALONE) -> int:
    """Number of missions side by side, below `total` since some missions last long.

    A CPU holds them in its caches, an accelerator in a small part of its memory, and more the more
    there are.
    """
    memory = devices.memory()
    if memory is None:
        most = min(_MOST_OF_CPU, max(_LEAST_OF_CPU, _CACHE // _bytes_of_state(config)))
        return min(most * workers.number, -(-total // 3))
    share = max(1, int(_SHARE_OF_MEMORY * memory) // _bytes_of_state(config))
    pays = math.isqrt(_AS_LONG_AS_NONE * total * workers.number)
    return min(total, pays, min(_MOST_OF_ACCELERATOR, share) * workers.number)


def _bytes_of_state(config: Config) -> int:
    """Approximate size of a mission's state: its roadmap, its robots' maps and some more."""
    robots, num_classes = len(config.carried), len(config.arena.classes)
    views = config.arena.num_pois * VIEW_SIDES * len(VIEW_DISTANCES)
    nodes = config.arena.num_pois * NODES_PER_POI
    numbers = nodes * (nodes + robots)
    if config.mission.communication.own_maps:
        numbers += robots * MOST_LOOKS * (robots + 2 * num_classes)
    return 2**13 + 4 * numbers + nodes * views


def runs_long(config: Config, total: int) -> bool:
    """Whether `total` missions take longer than it takes to compile faster programs."""
    return total * config.arena.num_pois >= _MANY_POIS


class Ledger:
    """Assigns missions to the P x S slots of a batch, whose P parts lie on devices of their own.

    A mission that is done makes room for the next one of its part, from a reserve of P x S missions
    that have begun.
    """

    def __init__(self, waiting: Sequence[Int[np.ndarray, " _"]], slots: int):
        """Lets the missions of each of the P parts wait for its S slots."""
        self._waiting = [missions.tolist() for missions in waiting]
        self._playing = np.full((len(waiting), slots), -1, np.int32)  # idle slots
        self._reserve = self._playing.copy()  # missions that are still there

    @property
    def is_over(self) -> bool:
        """Whether all missions are done."""
        return not any(self._waiting) and max(self._playing.max(), self._reserve.max()) < 0

    @property
    def needs_reserve(self) -> bool:
        """Whether missions wait in a part whose reserve is used up."""
        parts = zip(self._waiting, self._reserve, strict=True)
        return any(bool(waiting) and reserve.max() < 0 for waiting, reserve in parts)

    def reserve(self) -> Int[np.ndarray, " B"]:
        """Begins a new reserve: `[P * S]` missions. Where a part has fewer, one fills the rest."""
        for waiting, reserve in zip(self._waiting, self._reserve, strict=True):
            first = [*reserve[reserve >= 0].tolist(), *waiting]
            some, waiting[:] = first[: len(reserve)], first[len(reserve) :]
            reserve[:] = some + [-1] * (len(reserve) - len(some))
        return np.maximum(self._reserve, 0).reshape(-1)

    def fill(self) -> Int[np.ndarray, " B"]:
        """Gives idle slots to missions of the reserve.

        Returns:
          `[P * S]` index of the mission that each slot takes, within the reserve of its part; -1 if
          the slot keeps its own.
        """
        taken = np.full_like(self._playing, -1)
        for part, (playing, reserve) in enumerate(zip(self._playing, self._reserve, strict=True)):
            idle, ready = np.flatnonzero(playing < 0), np.flatnonzero(reserve >= 0)
            number = min(len(idle), len(ready))
            idle, ready = idle[:number], ready[:number]
            taken[part, idle], playing[idle], reserve[ready] = ready, reserve[ready], -1
        return taken.reshape(-1)

    @property
    def playing(self) -> Int[np.ndarray, " B"]:
        """`[P * S]` mission in each slot; -1 in idle ones."""
        return self._playing.reshape(-1)

    def end(self, done: Bool[np.ndarray, " B"]) -> Int[np.ndarray, " _"]:
        """Ends missions in slots that are `done`; returns the slots that are idle from now on."""
        slots = np.flatnonzero(done & (self.playing >= 0))
        self.playing[slots] = -1
        return slots
