"""How robots drive, and the missions that they drive in."""

from jaxsense.config.checks import (
    require,
    require_at_most,
    require_not_negative,
    require_positive,
    require_types,
)
from jaxsense.config.scene import ROBOT_RADIUS, TIMESTEP
from jaxsense.config.section import Traced, section

MOST_EPISODES = 100_000
"""Missions of one policy whose states fit the memory of a computer."""


@section
class NavigationConfig:
    """How a robot finds its way: the paper's move_base, with the AMiRo's numbers."""

    horizon: Traced[float] = 2.0
    """How far ahead a trajectory is rolled out, in seconds."""
    speed_samples: int = 6
    """Forward speeds that are tried, one of them backwards."""
    turn_samples: int = 21
    """Turn rates that are tried."""
    robot_radius: Traced[float] = 0.1
    """Radius that a robot is given in planning, in metres; it measures 0.05."""
    inflation: Traced[float] = 0.1
    """Distance to obstacles below which a way is held to be worse, in metres."""
    goal_distance: Traced[float] = 0.2
    """How near a viewpoint counts as reached if the PoI is in view, in metres."""
    goal_angle: Traced[float] = 6.0
    """Largest angle to the PoI at which a robot scans it, in degrees."""
    view_distances: Traced[tuple[float, ...]] = (0.5, 0.9)
    """Distances of viewpoints from a PoI's centre, in metres."""
    view_sides: int = 16
    """Directions of viewpoints around a PoI."""
    view_range: Traced[float] = 1.0
    """Longest distance from which a robot scans a PoI, in metres."""
    stuck_time: Traced[float] = 6.0
    """Seconds without progress after which a robot backs off and tries another viewpoint."""
    recovery_time: Traced[float] = 1.0
    """Seconds for which a robot backs off."""

    def check(self) -> None:
        """Raises `ConfigError` for a field that cannot be used."""
        require_types(self)
        require_positive(self, "horizon", "robot_radius", "goal_distance", "goal_angle")
        require(self.horizon >= 1.0, self, "horizon", "must be at least 1 s")
        require_positive(self, "view_sides", "view_range", "stuck_time", "recovery_time")
        require_not_negative(self, "inflation")
        require_at_most(self, horizon=60, speed_samples=101, turn_samples=101, view_sides=360)
        require(self.speed_samples >= 3, self, "speed_samples", "must be at least 3")
        odd = self.turn_samples >= 3 and self.turn_samples % 2 == 1
        require(odd, self, "turn_samples", "must be odd and at least 3, so that one goes straight")
        require(
            self.robot_radius > ROBOT_RADIUS, self, "robot_radius", f"must be above {ROBOT_RADIUS}"
        )
        require(self.goal_angle <= 10, self, "goal_angle", "must be at most 10 degrees")
        require(
            1 <= len(self.view_distances) <= 20 and all(d > 0 for d in self.view_distances),
            self,
            "view_distances",
            "must be 1 to 20 distances, each greater than 0",
        )


@section
class MissionConfig:
    """The closed loop of all robots in one arena."""

    episodes: int = 128
    """Missions that are played with each policy at the end of a run."""
    time_limit: Traced[float] = 120.0
    """Seconds after which a mission ends in any case."""
    control_period: float = 0.1
    """Seconds between two decisions of a robot; also between two scans."""
    equal_values: Traced[float] = 0.1
    """Actions whose values differ by less than this from the best count as equally good, in inverse
    latent units; the robot takes the PoI that no other robot is heading for, and of these the
    nearest."""
    least_confidence: Traced[float] = 0.98
    """Probability that a detector must give to its answer for it to be written into the map."""
    attempts: Traced[int] = 3
    """Looks that detect nothing, or goals that are not reached, after which a robot gives a PoI
    up."""

    def check(self) -> None:
        """Raises `ConfigError` for a field that cannot be used."""
        require_types(self)
        require_positive(self, "episodes", "time_limit", "control_period", "attempts")
        require_at_most(self, episodes=MOST_EPISODES, time_limit=3600)
        steps = self.control_period / TIMESTEP
        require(
            abs(steps - round(steps)) < 1e-6 and 5 <= round(steps) <= 20,
            self,
            "control_period",
            f"must be a multiple of {TIMESTEP} s within {5 * TIMESTEP} and {20 * TIMESTEP} s",
        )
        require(
            self.time_limit >= self.control_period, self, "time_limit", "must be a period or more"
        )
        require_not_negative(self, "equal_values")
        require(
            0 <= self.least_confidence < 1, self, "least_confidence", "must be at least 0, below 1"
        )
