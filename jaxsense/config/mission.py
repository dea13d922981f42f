"""Settings of navigation and of missions."""

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
"""Most missions of one policy whose states fit a computer's memory."""

POLICIES = (
    *("latent", "greedy", "bayes", "optimal", "naive", "naive_2", "naive_3", "random"),
    *("nearest", "auction", "rollout"),
)
"""Policies of robots in missions; the index is the policy's code. `latent` asks the Q-networks.
`greedy` takes the look of the highest expected gain on the map, `bayes` on the exact posterior over
the classes, and `optimal` the look of the highest total gain by dynamic programming. With `naive`
every robot looks at every PoI once, with `naive_2` twice, with `naive_3` three times. `random`
takes any PoI, or ends. The last three know ways as well as gains on the map, see `dqn.rules`:
`nearest` takes the nearest PoI of which it expects to learn, `auction` shares these out among the
robots by their times, and `rollout` takes the one with the highest gain for each second."""

KNOW_WAYS = ("nearest", "auction", "rollout")
"""Policies whose values count ways, so that no rule of traffic breaks ties."""

MISSIONS_AT_ONCE = 384
"""Most missions that are played side by side."""
NODES_PER_POI = 10
"""Waypoints of the roadmap around each PoI."""


@section
class NavigationConfig:
    """Navigation of a robot: the paper's move_base, with the AMiRo's numbers."""

    horizon: Traced[float] = 2.0
    """Length of a trajectory, in seconds."""
    speed_samples: int = 6
    """Speeds to try, one of them backwards."""
    turn_samples: int = 21
    """Turn rates to try."""
    robot_radius: Traced[float] = 0.1
    """Radius of a robot in planning, in metres; its body's is 0.05."""
    inflation: Traced[float] = 0.1
    """Distance to obstacles below which a way costs more, in metres."""
    goal_distance: Traced[float] = 0.2
    """Distance at which a viewpoint counts as reached if the PoI is in view, in metres."""
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
    """Seconds that a robot backs off."""

    def check(self) -> None:
        """Raises `ConfigError` for an invalid field."""
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

    @property
    def margin(self) -> float:
        """Free space around a robot's body in planning, in metres."""
        return self.robot_radius - ROBOT_RADIUS


@section
class MissionConfig:
    """The closed loop of all robots in one arena."""

    policies: tuple[str, ...] = ("latent", "naive", "random")
    """Policies to play missions with at the end of a run; `jaxsense.evaluate` plays all."""
    episodes: int = 128
    """Missions per policy at the end of a run."""
    time_limit: Traced[float] = 120.0
    """Longest mission, in seconds."""
    control_period: float = 0.1
    """Seconds between a robot's decisions, and between its scans."""
    equal_values: Traced[float] = 0.1
    """Actions whose values are this close to the best, in units of the reward, count as equally
    good; see `nearest_first` and `avoids_targets`."""
    nearest_first: Traced[bool] = True
    """Whether a robot takes the nearest of equally good PoIs; otherwise the first."""
    redecides: Traced[bool] = True
    """Whether a robot under way decides again when the map changes."""
    avoids_targets: Traced[bool] = True
    """Whether a robot prefers, of equally good PoIs, those that no other robot heads for."""
    least_confidence: Traced[float] = 0.98
    """Lowest probability of a detected label for a scan to enter the map."""
    attempts: Traced[int] = 3
    """Failed looks or goals after which a robot gives up a PoI. Where it was stuck, it tries as
    often once more before it ends."""

    def check(self) -> None:
        """Raises `ConfigError` for an invalid field."""
        require_types(self)
        require_positive(self, "episodes", "time_limit", "control_period", "attempts")
        known = f"must name some of {', '.join(POLICIES)}"
        is_known = len(self.policies) > 0 and set(self.policies) <= set(POLICIES)
        require(is_known, self, "policies", known)
        is_once = len(set(self.policies)) == len(self.policies)
        require(is_once, self, "policies", "must name no policy twice")
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
