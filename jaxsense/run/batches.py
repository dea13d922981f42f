"""How many missions play side by side, and for how long between two looks at them.

The batch follows from the memory, so that no check of the settings needs to count missions: the
limits of PoIs, robots and viewpoints bound the state of one, and `batch_of` how many there are.
"""

import math

from jaxsense.config import CONTROL_PERIOD, NODES_PER_POI, VIEW_SIDES, Config
from jaxsense.core import checks
from jaxsense.mission.memory import MOST_LOOKS
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
    """How many missions to play side by side.

    Args:
      config: all settings.
      total: number of missions.
      workers: share the missions.

    Returns:
      Fewer than all, since some last long: on a CPU no more than its caches hold, but at least a
      few; on an accelerator more, the more there are, as far as they fit into a small part of its
      memory.

    Raises:
      ValueError: if `total` is not a number greater than 0.
    """
    checks.require_number("total", total)
    memory = devices.memory()
    if memory is None:
        most = min(_MOST_OF_CPU, max(_LEAST_OF_CPU, _CACHE // _bytes_of_state(config)))
        return min(most * workers.number, -(-total // 3))
    share = max(1, int(_SHARE_OF_MEMORY * memory) // _bytes_of_state(config))
    pays = math.isqrt(_AS_LONG_AS_NONE * total * workers.number)
    return min(total, pays, min(_MOST_OF_ACCELERATOR, share) * workers.number)


def _bytes_of_state(config: Config) -> int:
    """Bytes of a mission's state, roughly: of its roadmap, its robots' maps and some more."""
    robots, num_classes = len(config.carried), len(config.arena.classes)
    views = config.arena.num_pois * VIEW_SIDES * len(VIEW_DISTANCES)
    nodes = config.arena.num_pois * NODES_PER_POI
    numbers = nodes * (nodes + robots)
    if config.mission.communication.own_maps:
        numbers += robots * MOST_LOOKS * (robots + 2 * num_classes)
    return 2**13 + 4 * numbers + nodes * views


def runs_long(config: Config, total: int) -> bool:
    """Whether missions take longer than it takes to compile faster programs.

    Args:
      config: all settings.
      total: number of missions.
    """
    return total * config.arena.num_pois >= _MANY_POIS
