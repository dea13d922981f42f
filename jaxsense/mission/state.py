"""The state of missions, and the parts that all missions of a configuration share."""

import dataclasses
import functools
from collections.abc import Iterable, Mapping

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Shaped

from jaxsense.config import Config, ConfigError
from jaxsense.config.mission import CONTROL_PERIOD
from jaxsense.config.section import FrozenDict
from jaxsense.core import checks
from jaxsense.core.types import Belief, Index, others, pytree
from jaxsense.dqn.policies import Values, table
from jaxsense.mission.maps import Memory, OwnMap, SharedMap
from jaxsense.mission.roadmap import Roadmap
from jaxsense.sim import arena as arenas
from jaxsense.sim import sensors
from jaxsense.sim import world as worlds
from jaxsense.sim.arena import Arena
from jaxsense.sim.world import Scene, World

ATTEMPTS = 3
"""Failed looks or goals after which a robot gives up a PoI, or retries where it was stuck."""
RECENT_LOOKS = 32
"""Looks by a sensor at a PoI whose places are remembered."""

IDLE, DRIVING, FACING, BACKING, ENDED, FAILED = range(6)
"""Phases of a robot: asking its policy, driving to a viewpoint, turning to a PoI to scan it,
backing off when stuck, and from `ENDED` on over: ended by NOP, or failed."""


@pytree
class Faults:
    """Times at which robots fail, in seconds from the start; infinite for never.

    Attributes:
      stops_at: when the robot stops for good.
      blind_at: when its sensor goes blind, unknown to the robot.
    """

    stops_at: Float[Array, " R"]
    blind_at: Float[Array, " R"]


@pytree
class Robots:
    """State of the robots, `[R]` each unless another shape is listed.

    Attributes:
      target: PoI, N for none, or -1 if the policy's values were NaN.
      view: viewpoint of the target, or V for the robot's current position.
      to_view: length of the path to it from each node of the roadmap, in metres.
      decided_on: version of the map at the last decision.
      excluded: viewpoints of the target that have failed or were occupied.
      path_left: metres left to the viewpoint at the last progress.
      unreachable: PoIs given up because no path leads there, or because the robot was stuck on
        the last attempt or found all viewpoints occupied.
      undetected: PoIs given up after a last look that showed nothing.
      exhausted: PoIs at which no look of the robot's would be new.
      tried_again: the robot has already retried the PoIs it had given up.
      goals: viewpoints that the robot set out for and unreachable PoIs, except goals that a new
        decision or another robot made obsolete.
      detections: scans that updated the map.
    """

    phase: Int[Array, " R"]
    target: Int[Array, " R"]
    view: Int[Array, " R"]
    to_view: Float[Array, "R K"]
    command: Float[Array, "R 2"]
    decided_on: Int[Array, " R"]
    excluded: Bool[Array, "R V+1"]
    attempts: Int[Array, " R"]
    path_left: Float[Array, " R"]
    progress_at: Float[Array, " R"]
    backs_off_until: Float[Array, " R"]
    unreachable: Bool[Array, "R N"]
    undetected: Bool[Array, "R N"]
    exhausted: Bool[Array, "R N"]
    tried_again: Bool[Array, " R"]
    goals: Int[Array, " R"]
    reached: Int[Array, " R"]
    looks: Int[Array, " R"]
    detections: Int[Array, " R"]


@pytree
class MissionState:
    """State of one mission.

    Attributes:
      pose_error: pose that each robot believes it has minus its true pose: x [m], y [m] and yaw
        [rad].
      classes: true classes, hidden from the robots.
      policy: index into `Mission.policies`.
      warmstart: MJX's last accelerations.
      belief: the map of all looks; robots that keep maps of their own decide by these.
      log_posterior: logarithms of the classes' probabilities by exact Bayes, for the policies
        `bayes` and `optimal`.
      times_seen: number of detections of each PoI by each modality.
      looked_from: places from which each modality has last detected each PoI, as the robots
        believe, in metres; infinite for none.
      memory: the looks that each robot knows of; None where all robots share one map.
      steps: control periods since the start.
      contacts: control periods in which a robot touched something.
    """

    scene: Scene
    pose_error: Float[Array, "R 3"]
    classes: Int[Array, " N"]
    roadmap: Roadmap
    faults: Faults
    policy: Int[Array, ""]
    velocity: Float[Array, "R 3"]
    warmstart: Float[Array, "3*R"]
    belief: Belief
    log_posterior: Float[Array, "N C"]
    times_seen: Int[Array, "N M"]
    looked_from: Float[Array, "N M K 2"]
    memory: Memory | None
    robots: Robots
    steps: Int[Array, ""]
    contacts: Int[Array, ""]
    done: Bool[Array, ""]

    @property
    def believed_poses(self) -> Float[Array, "*B R 3"]:
        """The poses that robots believe they have, and tell the others; see `Scene.poses`."""
        return self.scene.poses + self.pose_error

    @property
    def seen(self) -> Bool[Array, "... N M"]:
        """Which modalities have detected which PoI."""
        return self.times_seen > 0

    @property
    def time(self) -> Float[Array, "..."]:
        """Seconds since the start."""
        return self.steps * CONTROL_PERIOD

    def with_robot(self, robot: Index, **changes: jax.Array) -> "MissionState":
        """Changes one robot."""
        put = lambda rows, x: rows.at[robot].set(x, wrap_negative_indices=False)  # noqa: E731
        changed = {name: put(getattr(self.robots, name), x) for name, x in changes.items()}
        return dataclasses.replace(self, robots=dataclasses.replace(self.robots, **changed))


def rows_at(x: Shaped[Array, "R ..."], index: Index | Int[Array, " S"]) -> Shaped[Array, "..."]:
    """One row or several, by indices from 0, which makes smaller programs than `x[index]`."""
    return x.at[index].get(mode="promise_in_bounds", wrap_negative_indices=False)


@pytree
class Record:
    """Record of one control period, for plots and tests.

    Attributes:
      scanned: the robot took a scan.
      detected: the scan updated the map.
    """

    time: Float[Array, ""]
    poses: Float[Array, "R 3"]
    command: Float[Array, "R 2"]
    phase: Int[Array, " R"]
    target: Int[Array, " R"]
    scanned: Bool[Array, " R"]
    detected: Bool[Array, " R"]
    belief: Belief
    seen: Bool[Array, "N M"]


@dataclasses.dataclass(frozen=True)
class Mission:
    """Arenas, settings and policies that missions share. Static under `jit`, compared by value.

    Attributes:
      world: the simulation, with contacts or without.
      free_arena: the same robots in an empty arena, see `rollout.move`.
      policies: by name; a mission's policy is an index into them.
    """

    world: World
    free_arena: Arena
    config: Config
    policies: FrozenDict[str, Values]

    def policy(self, name: str) -> int:
        """The index of a policy."""
        if name not in self.policies:
            raise ConfigError("policy", name, f"must be one of {', '.join(self.policies)}")
        return [*self.policies].index(name)

    def playing(self, policies: Iterable[str]) -> "Mission":
        """The mission with some of its policies: programs hold all that it has."""
        played = {*policies}
        left = {name: each for name, each in self.policies.items() if name in played}
        return dataclasses.replace(self, policies=FrozenDict(left))

    @property
    def modalities(self) -> Int[Array, " R"]:
        """Index of each robot's sensor."""
        return jnp.array(self.config.modality_of_robot)

    def map_of(self, state: MissionState, robot: Index) -> SharedMap | OwnMap:
        """The map that a robot decides by."""
        if state.memory is None:
            looked_from = state.looked_from
            return SharedMap(state.belief, state.log_posterior, state.times_seen, looked_from)
        is_known = state.memory.known_to(robot, state.time)
        return OwnMap(state.memory, is_known, self.config.arena.num_pois)


class Robot:
    """One robot in a mission's state, with what it believes and knows.

    Attributes:
      pose: that it believes it has.
      target: its target; the last PoI if it has none, so that an index is valid.
      modality: index of its sensor.
      map: that it decides by.
    """

    def __init__(self, mission: Mission, state: MissionState, index: Index):
        """Works out what several decisions need."""
        self.mission, self.state, self.index = mission, state, index
        self.pose = state.believed_poses[index]
        self.target = jnp.minimum(state.robots.target[index], mission.config.arena.num_pois - 1)
        self.modality = mission.modalities[index]
        self.map = mission.map_of(state, index)

    @functools.cached_property
    def own(self) -> Robots:
        """Its part of the state."""
        return jax.tree.map(lambda x: rows_at(x, self.index), self.state.robots)

    @functools.cached_property
    def standing(self) -> Float[Array, "_ 2"]:
        """Positions of the other robots; moving ones, which will be gone, count as far away."""
        phase = others(self.state.robots.phase, self.index)
        moves = (phase == DRIVING) | (phase == BACKING)
        places = others(self.state.believed_poses[:, :2], self.index)
        return jnp.where(moves[:, None], 1e3, places)


@checks.typed
def make_mission(
    config: Config,
    policies: Mapping[str, Values] | None = None,
    *,
    contacts: bool = True,
) -> Mission:
    """Makes the mission that `config` describes.

    Args:
      config: all settings; numbers that are declared `Traced` may be traced.
    """
    on_top = sensors.on_top(config, config.carried)
    return Mission(
        world=worlds.make_world(config, config.carried, contacts=contacts),
        free_arena=arenas.build(config.arena, on_top, obstacles=False),
        config=config,
        policies=FrozenDict(table(policies)),
    )


@checks.typed
def no_faults(config: Config) -> Faults:
    """Makes the faults of robots that never fail."""
    never = jnp.full(len(config.carried), jnp.inf, jnp.float32)
    return Faults(never, never)
