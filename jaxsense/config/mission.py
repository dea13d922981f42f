"""Settings of navigation and of missions."""

from jaxsense.config.checks import limited, require
from jaxsense.config.scene import ROBOT_RADIUS, TIMESTEP
from jaxsense.config.section import Section, Traced

MAX_EPISODES = 100_000
"""Maximum number of missions of one policy."""
NODES_PER_POI = 10
"""Number of waypoints of the roadmap around each PoI."""
VIEW_SIDES = 16
"""Number of directions from which a PoI has viewpoints."""


class NavigationConfig(Section, place="navigation"):
    """Navigation of a robot: the paper's move_base, with the AMiRo's parameters."""

    horizon: Traced[float] = limited(2.0, at_least=1, at_most=60)
    """Length of the trajectories that a robot simulates to choose its speed, in seconds."""
    robot_radius: Traced[float] = limited(0.1, above=ROBOT_RADIUS)
    """Radius of a robot in planning, in metres; that of its body is 0.05."""
    inflation: Traced[float] = limited(0.1, at_least=0)
    """Distance to obstacles below which a trajectory costs more, in metres."""
    view_distances: Traced[tuple[float, ...]] = limited(
        (0.5, 0.9), above=0, min_items=1, max_items=20
    )
    """Distances of viewpoints from a PoI's centre, in metres."""
    view_range: Traced[float] = limited(1.0, above=0)
    """Maximum distance from which a robot scans a PoI, in metres."""

    @property
    def margin(self) -> float:
        """Free space around a robot's body in planning, in metres."""
        return self.robot_radius - ROBOT_RADIUS


class SearchConfig(Section, place="mission.localisation.search"):
    """Robots with localisation errors search their scans for the PoI; off by default.

    The detector judges all windows and distances that such errors could explain. A robot also
    keeps a distance of at least `viewpoint.min_distance` plus `position` from the PoI.
    """

    position: float = limited(0.0, at_least=0, at_most=0.3)
    """Largest error of a robot's position that the search allows for, in metres, for example three
    times `position_error`."""
    heading: float = limited(0.0, at_least=0, at_most=30)
    """Largest error of a robot's heading that the search allows for, in degrees, for example three
    times `heading_error`."""

    @property
    def applies(self) -> bool:
        """Whether robots search at all."""
        return self.position > 0 or self.heading > 0


class LocalisationConfig(Section, place="mission.localisation"):
    """Localisation errors, by which believed poses differ from true ones; 0 in all presets.

    All errors are normally distributed, and those of x and y are independent.
    """

    in_training: bool = False
    """Whether detectors and policies also learn from looks with the constant errors; they never
    learn from errors that driving adds."""
    position_error: Traced[float] = limited(0.0, at_least=0, at_most=1)
    """Standard deviation of the constant error of a robot's x and y in a mission, in metres."""
    heading_error: Traced[float] = limited(0.0, at_least=0, at_most=180)
    """Standard deviation of the constant error of a robot's heading in a mission, in degrees."""
    position_drift: Traced[float] = limited(0.0, at_least=0, at_most=1)
    """Standard deviation of the errors of x and y that one metre of driving adds, in metres; it
    grows with the square root of the distance."""
    heading_drift: Traced[float] = limited(0.0, at_least=0, at_most=180)
    """Standard deviation of the error of the heading that one metre of driving adds, in degrees; it
    grows with the square root of the distance."""
    search: SearchConfig = SearchConfig()
    """Search of scans for the PoI, for robots with localisation errors."""


class CommunicationConfig(Section, place="mission.communication"):
    """Messages between robots about their looks, which may be lost or late."""

    own_maps: bool = False
    """Whether each robot decides from its own map, which its looks and messages from the others
    update; otherwise all robots share one map. Requires `jmvae.fusion` = `filter`, with which looks
    add up."""
    loss: Traced[float] = limited(0.0, at_least=0, at_most=0.95)
    """Share of messages that are lost; only with `own_maps`."""
    delay: Traced[float] = limited(0.0, at_least=0, at_most=3600)
    """Mean delay of a message, in seconds; each delay is drawn from 0 to twice the mean. Only with
    `own_maps`."""
    period: Traced[float] = limited(1.0, above=0, at_most=3600)
    """Seconds after which a robot repeats its message; it also sends one after each look."""

    def check(self) -> None:
        """Checks that messages are sent if they are lost or late; raises `ConfigError`."""
        for name in ("loss", "delay"):
            is_used = self.own_maps or getattr(self, name) == 0
            require(is_used, self, name, "must be 0 without mission.communication.own_maps")


class MissionConfig(Section, place="mission"):
    """Missions, in which all robots act in closed loop in one arena."""

    policies: tuple[str, ...] = limited(("latent", "naive", "random"), min_items=1)
    """Policies that play missions at the end of a run: any of `latent`, `network`, `greedy`,
    `bayes`, `optimal`, `naive`, `naive_2`, `naive_3`, `random`, `nearest`, `auction`, `rollout` and
    custom policies. `jaxsense.evaluate` plays all of them."""
    episodes: int = limited(128, at_least=1, at_most=MAX_EPISODES)
    """Missions per policy at the end of a run."""
    time_limit: Traced[float] = limited(120.0, above=0, at_most=3600)
    """Maximum length of a mission, in seconds."""
    control_period: float = 0.1
    """Seconds between a robot's decisions, and between its scans."""
    auctions: Traced[bool] = True
    """Whether robots divide the PoIs that are worth a look among themselves by an auction, in which
    they bid travel times, if their policy prescribes no order. Otherwise, they follow its values,
    and `equal_values`, `avoids_targets` and `nearest_first` break ties."""
    equal_values: Traced[float] = limited(0.1, at_least=0)
    """Tolerance, in units of the reward: actions whose values are this close to the best count as
    equally good; see `avoids_targets` and `nearest_first`."""
    nearest_first: Traced[bool] = True
    """Whether a robot takes the nearest of equally good PoIs; otherwise the first."""
    redecides: Traced[bool] = True
    """Whether a robot under way decides again when the map changes."""
    avoids_targets: Traced[bool] = True
    """Whether a robot prefers, among equally good PoIs, those that no other robot heads for."""
    least_confidence: Traced[float] = limited(0.98, at_least=0, below=1)
    """Minimum probability of the most likely label for a scan to update the map."""
    attempts: Traced[int] = limited(3, at_least=1)
    """Number of failed looks or goals after which a robot gives up a PoI. Before it finishes, it
    retries PoIs where it was stuck, with the same number of attempts."""
    localisation: LocalisationConfig = LocalisationConfig()
    """Localisation errors."""
    communication: CommunicationConfig = CommunicationConfig()
    """Messages between robots about their looks."""

    def check(self) -> None:
        """Checks the control period, and that no policy repeats; raises `ConfigError`."""
        is_once = len(set(self.policies)) == len(self.policies)
        require(is_once, self, "policies", "must name no policy twice")
        steps = self.control_period / TIMESTEP
        is_multiple = abs(steps - round(steps)) < 1e-6 and 5 <= round(steps) <= 20
        limits = f"from {5 * TIMESTEP} to {20 * TIMESTEP} s"
        expected = f"must be a multiple of {TIMESTEP} s {limits}"
        require(is_multiple, self, "control_period", expected)
        is_long = self.time_limit >= self.control_period
        require(is_long, self, "time_limit", "must be at least control_period")
