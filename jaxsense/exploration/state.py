"""The state of missions in unknown places, and their start."""

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxsense.config import Config, ConfigError
from jaxsense.config.mission import CONTROL_PERIOD
from jaxsense.core import checks
from jaxsense.core.types import Index, Key, pytree
from jaxsense.exploration import grid as grids
from jaxsense.exploration import slots as objects
from jaxsense.exploration.grid import Grid
from jaxsense.exploration.slots import Slots
from jaxsense.mission.navigation import clearance
from jaxsense.mission.state import ATTEMPTS, Mission
from jaxsense.models import Models
from jaxsense.sim import amiro, localisation
from jaxsense.sim import arena as arenas
from jaxsense.sim.light import random_light
from jaxsense.sim.world import Scene

NUM_FRONTIERS = 12
"""Frontiers that a robot chooses from."""
SPARE_SLOTS = 4
"""Slots beyond the largest number of PoIs, for false candidates until they are refuted."""
AT_GOAL = 0.1
"""Distance from a goal at which a robot is there, in metres."""
_CERTAIN = 10.0  # log-odds of objects
_CLEAR = 4  # evidence of cells
_EXACT = 1e-4  # of a square metre
_START_ROOM = 0.35  # m, between a robot and everything else at the start
_TOGETHER = 1.0  # m in x and y, from the first robot to the others
_NUM_CANDIDATES = 64


def num_slots(config: Config) -> int:
    """S, the size of the map."""
    return config.arena.num_pois + SPARE_SLOTS


@pytree
class Explorers:
    """State of the robots, `[R]` each unless another shape is listed.

    Attributes:
      command: forward speed [m/s] and turn rate [rad/s].
      target: the action of the last decision: a slot below S, a frontier below S + F, or S + F for
        nothing to do.
      goal: x [m], y [m] and yaw [rad] in which it drives.
      way: lengths of the shortest paths from each cell to the goal, in metres.
      left: metres to the goal at the last progress, and `progress_at` when that was.
      backs_off_until: seconds from the start.
      looks: scans that a robot took where it can look at its target.
      reconsiders: must decide, because a look or an obstacle has ended its last decision.
    """

    command: Float[Array, "R 2"]
    target: Int[Array, " R"]
    goal: Float[Array, "R 3"]
    way: Float[Array, "R K K"]
    left: Float[Array, " R"]
    progress_at: Float[Array, " R"]
    backs_off_until: Float[Array, " R"]
    looks: Int[Array, " R"]
    reconsiders: Bool[Array, " R"]


@pytree
class ExplorationState:
    """State of one mission; for what it shares with a known arena see `mission.MissionState`.

    Attributes:
      grid: floor and walls that robots have seen.
      slots: the map of objects.
      failures: looks by each modality at each slot that told nothing, or had no way there.
      failed_from: places of the latest of these, in metres; infinite for none.
      pose_error: see `sim.localisation`.
    """

    scene: Scene
    classes: Int[Array, " N"]
    velocity: Float[Array, "R 3"]
    warmstart: Float[Array, "3*R"]
    grid: Grid
    slots: Slots
    failures: Int[Array, "S M"]
    failed_from: Float[Array, "S M A 2"]
    pose_error: Float[Array, "R 3"]
    robots: Explorers
    steps: Int[Array, ""]
    contacts: Int[Array, ""]
    done: Bool[Array, ""]

    @property
    def time(self) -> Float[Array, "..."]:
        """Seconds since the start."""
        return self.steps * CONTROL_PERIOD

    @property
    def believed_poses(self) -> Float[Array, "*B R 3"]:
        """Poses that robots believe they have: x [m], y [m] and yaw [rad]."""
        return self.scene.poses + self.pose_error

    def with_robot(self, robot: Index, **changes: jax.Array) -> "ExplorationState":
        """Changes one robot."""
        changed = {n: getattr(self.robots, n).at[robot].set(x) for n, x in changes.items()}
        return dataclasses.replace(self, robots=dataclasses.replace(self.robots, **changed))

    def target_slot(self, robot: Index) -> Int[Array, ""]:
        """The slot that a robot heads for; the last one if it heads for none."""
        return jnp.minimum(self.robots.target[robot], len(self.slots.is_used) - 1)

    def is_at_goal(self, robot: Index) -> Bool[Array, ""]:
        """Whether a robot has arrived, as it believes."""
        way = self.robots.goal[robot, :2] - self.believed_poses[robot, :2]
        return jnp.linalg.norm(way) < AT_GOAL

    def with_failure(
        self, robot: Index, modality: Index, fails: Bool[Array, ""], position: Float[Array, "2"]
    ) -> "ExplorationState":
        """Notes from where a look at the robot's target failed; cleared slots have no failures."""
        target, is_used = self.target_slot(robot), self.slots.is_used
        number, places = self.failures[target, modality], self.failed_from
        at = number % places.shape[2]
        place = jnp.where(fails, position, places[target, modality, at])
        places = places.at[target, modality, at].set(place)
        failures = self.failures.at[target, modality].set(number + fails)
        return dataclasses.replace(
            self,
            failures=jnp.where(is_used[:, None], failures, 0),
            failed_from=jnp.where(is_used[:, None, None, None], places, jnp.inf),
        )


@checks.typed
def reset(key: Key, mission: Mission, models: Models) -> ExplorationState:
    """Starts a mission in a random arena, of which the robots know the outer walls alone.

    Raises:
      ConfigError: if no robot can measure distances.
    """
    config, num_robots = mission.config, len(mission.config.carried)
    if not any(mission.world.sensors[m].measures_distance for m in config.modality_of_robot):
        expected = "must include one whose sensor measures distances: it shows floor and walls"
        raise ConfigError("robots", config.carried, expected)
    class_key, layout_key, light_key, pose_key, error_key = jax.random.split(key, 5)
    num_pois = config.arena.num_pois
    classes = jax.random.randint(class_key, (num_pois,), 0, len(config.arena.classes))
    layout = arenas.random_layout(layout_key, config.arena, classes)
    poses = _random_poses(pose_key, mission, layout)
    error = localisation.draw(error_key, config.mission.localisation, num_robots)
    grid = grids.empty(config.arena.side, len(config.modalities))
    size = num_slots(config), len(config.modalities)
    nothing = size[0] + NUM_FRONTIERS
    return ExplorationState(
        scene=Scene(layout, random_light(light_key, mission.world.reads_conditions), poses),
        classes=classes,
        velocity=jnp.zeros((num_robots, 3)),
        warmstart=jnp.zeros(3 * num_robots),
        grid=grid,
        slots=objects.empty(models, size[0]),
        failures=jnp.zeros(size, jnp.int32),
        failed_from=jnp.full((*size, ATTEMPTS, 2), jnp.inf),
        pose_error=error,
        robots=Explorers(
            command=jnp.zeros((num_robots, 2)),
            target=jnp.full(num_robots, nothing, jnp.int32),
            goal=poses + error,
            way=jnp.zeros((num_robots, *grid.evidence.shape)),
            left=jnp.zeros(num_robots),
            progress_at=jnp.zeros(num_robots),
            backs_off_until=jnp.zeros(num_robots),
            looks=jnp.zeros(num_robots, jnp.int32),
            reconsiders=jnp.ones(num_robots, bool),
        ),
        steps=jnp.int32(0),
        contacts=jnp.int32(0),
        done=jnp.bool_(False),
    )


def told(mission: Mission, state: ExplorationState) -> ExplorationState:
    """The same mission for robots that know all walls and places, to compare with."""
    layout, grid, slots = state.scene.layout, state.grid, state.slots
    x, y = jnp.broadcast_arrays(grid.centres[:, None], grid.centres[None])
    is_wall = jnp.zeros(x.shape, bool)
    if len(layout.walls):
        is_wall = arenas.room_beside(layout.walls, x, y) < grid.cell / 2
    number = len(layout.present)
    there = jnp.pad(layout.present, (0, len(slots.is_used) - number))
    position = jnp.where(layout.present[:, None], layout.position, slots.position[:number])
    known = dataclasses.replace(
        slots,
        existence=jnp.where(there, _CERTAIN, slots.existence),
        is_used=there,
        position=slots.position.at[:number].set(position),
        covariance=jnp.where(there[:, None, None], _EXACT * slots.covariance, slots.covariance),
    )
    evidence = jnp.where(is_wall, _CLEAR, -_CLEAR).astype(grid.evidence.dtype)
    floor = dataclasses.replace(grid, evidence=evidence, seen=jnp.ones_like(grid.seen))
    return dataclasses.replace(state, grid=floor, slots=known)


def _random_poses(key: Key, mission: Mission, layout: arenas.Layout) -> Float[Array, "R 3"]:
    """Draws poses of a team that has been put down in one place, with room around the robots."""
    arena, num_robots = mission.config.arena, len(mission.config.carried)
    draws = jax.random.uniform(key, (num_robots, _NUM_CANDIDATES, 3), minval=-1.0)
    reach = arena.side / 2 - amiro.BODY_RADIUS - _START_ROOM

    def stand(taken: jax.Array, robot: jax.Array) -> tuple[jax.Array, jax.Array]:
        beside = jnp.clip(taken[:1] + _TOGETHER * draws[robot, :, :2], -reach, reach)
        places = jnp.where(robot == 0, reach * draws[robot, :, :2], beside)
        tried = jnp.concatenate([places, jnp.zeros((_NUM_CANDIDATES, 1))], axis=-1)
        to_fixed = jax.vmap(lambda pose: clearance(arena, layout, pose[None])[0][0])(tried)
        apart = jnp.linalg.norm(places[:, None] - taken[None], axis=-1)
        room = jnp.minimum(to_fixed, jnp.min(apart, axis=-1) - 2 * amiro.BODY_RADIUS) - _START_ROOM
        chosen = jnp.where(jnp.any(room > 0), jnp.argmax(room > 0), jnp.argmax(room))
        position = places[chosen]
        return taken.at[robot].set(position), jnp.append(position, jnp.pi * draws[robot, 0, 2])

    nowhere = jnp.full((num_robots, 2), jnp.inf)
    return jax.lax.scan(stand, nowhere, jnp.arange(num_robots))[1]
