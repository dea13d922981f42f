"""Settings of navigation and of missions."""

from typing import NamedTuple

from jaxsense.config.scene import ROBOT_RADIUS
from jaxsense.config.section import Section, Traced, limited, require

MAX_EPISODES = 100_000
"""Maximum number of missions of one policy."""
NODES_PER_POI = 10
"""Number of waypoints of the roadmap around each PoI."""
VIEW_SIDES = 16
"""Number of directions from which a PoI has viewpoints."""
CONTROL_PERIOD = 0.1
"""Seconds between a robot's decisions, and between its scans."""
PLANNING_RADIUS = 0.1
"""Radius of a robot in planning, in metres."""
MARGIN = PLANNING_RADIUS - ROBOT_RADIUS
"""Free space around a robot's body in planning, in metres."""


class NavigationConfig(Section, place="navigation"):
    """Navigation of a robot: the paper's move_base, with the AMiRo's parameters.

    Attributes:
      view_range: Maximum distance from which a robot scans a PoI, in metres.
    """

    view_range: Traced[float] = limited(1.0, above=0)


class Search(NamedTuple):
    """Largest errors of a pose for which robots search their scans for a PoI.

    Attributes:
      position: In metres.
      heading: In degrees.
    """

    position: float = 0.0
    heading: float = 0.0

    @property
    def applies(self) -> bool:
        """Whether robots search at all."""
        return self.position > 0 or self.heading > 0


class LocalisationConfig(Section, place="mission.localisation"):
    """Localisation errors, by which believed poses differ from true ones; 0 in all presets.

    Each setting has two numbers: metres for x and y, and degrees for the heading. Errors are normal
    and independent.

    Attributes:
      in_training: Whether detectors and policies also learn from looks with the constant errors;
        they never learn from errors that driving adds.
      error: Standard deviations of a robot's constant error in a mission, in metres and degrees.
      drift: Standard deviations of the errors that one metre of driving adds, in metres and
        degrees; they grow with the square root of the distance.
      search: Largest errors, in metres and degrees, for which robots search their scans for the
        PoI, for example three times `error`: the detector judges all windows and distances that
        they could explain, and a robot keeps at least `viewpoint.min_distance` plus the first
        number away.
    """

    in_training: bool = False
    error: Traced[tuple[float, float]] = limited((0.0, 0.0), at_least=0, at_most=180)
    drift: Traced[tuple[float, float]] = limited((0.0, 0.0), at_least=0, at_most=180)
    search: tuple[float, float] = limited((0.0, 0.0), at_least=0, at_most=30)

    def check(self) -> None:
        """Checks the limits of the errors of positions; raises `ConfigError`."""
        for name, most in (("error", 1.0), ("drift", 1.0), ("search", 0.3)):
            expected = f"must be at most {most} m and degrees, in this order"
            require(getattr(self, name)[0] <= most, self, name, expected)


class CommunicationConfig(Section, place="mission.communication"):
    """Messages between robots about their looks, which may be lost or late.

    Attributes:
      own_maps: Whether each robot decides from its own map, which its looks and messages from the
        others update; otherwise all robots share one map. Requires `jmvae.fusion` = `filter`, with
        which looks add up.
      loss: Share of messages that are lost; only with `own_maps`.
      delay: Mean delay of a message, in seconds; each delay is drawn from 0 to twice the mean. Only
        with `own_maps`.
    """

    own_maps: bool = False
    loss: Traced[float] = limited(0.0, at_least=0, at_most=0.95)
    delay: Traced[float] = limited(0.0, at_least=0, at_most=3600)

    def check(self) -> None:
        """Checks that messages are sent if they are lost or late; raises `ConfigError`."""
        for name in ("loss", "delay"):
            is_used = self.own_maps or getattr(self, name) == 0
            require(is_used, self, name, "must be 0 without mission.communication.own_maps")


class MissionConfig(Section, place="mission"):
    """Missions, in which all robots act in closed loop in one arena.

    Attributes:
      policies: Policies that play missions at the end of a run: any of `latent`,
        `greedy`, `bayes`, `optimal`, `naive`, `naive_2`, `naive_3`, `random`, `nearest`, `auction`,
        `rollout` and custom policies. `jaxsense.evaluate` plays all of them.
      episodes: Missions per policy at the end of a run.
      time_limit: Maximum length of a mission, in seconds.
      least_confidence: Minimum probability of the most likely label for a scan to update the map.
      localisation: Localisation errors.
      communication: Messages between robots about their looks.
    """

    policies: tuple[str, ...] = limited(("latent", "naive", "random"), min_items=1)
    episodes: int = limited(128, at_least=1, at_most=MAX_EPISODES)
    time_limit: Traced[float] = limited(120.0, at_least=CONTROL_PERIOD, at_most=3600)
    least_confidence: Traced[float] = limited(0.98, at_least=0, below=1)
    localisation: LocalisationConfig = LocalisationConfig()
    communication: CommunicationConfig = CommunicationConfig()

    def check(self) -> None:
        """Checks that no policy repeats; raises `ConfigError`."""
        is_once = len(set(self.policies)) == len(self.policies)
        require(is_once, self, "policies", "must name no policy twice")
