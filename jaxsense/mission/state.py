"""State of a mission, and its start."""

import dataclasses
from collections.abc import Mapping

import chex
import jax
import jax.numpy as jnp

from jaxsense.config import Config, ConfigError
from jaxsense.core import checks
from jaxsense.core.types import Belief, Index, Key, pytree
from jaxsense.dqn.policies import Policy, Values, table
from jaxsense.mission import roadmap
from jaxsense.mission.roadmap import Roadmap
from jaxsense.models import make_bayes, make_prior
from jaxsense.sim import arena as arenas_of
from jaxsense.sim import sensors
from jaxsense.sim import world as worlds
from jaxsense.sim.arena import Arena
from jaxsense.sim.world import Scene, World

IDLE, DRIVING, FACING, BACKING, ENDED, FAILED = range(6)
"""Phases of a robot: asking its policy, driving to a viewpoint, turning to a PoI and scanning it,
backing off when stuck, ended by NOP, or failed."""

_FREE_DRAWS = 32


@dataclasses.dataclass(frozen=True, eq=False)
class Mission:
    """The parts that all missions of a configuration share. Static under `jit`.

    Attributes:
      world: the simulation, with contacts or without.
      free_arena: its robots in an empty arena, see `motion.move`.
      config: all settings.
      policies: by name; a mission's policy is an index into them.
    """

    world: World
    free_arena: Arena
    config: Config
    policies: dict[str, Policy]

    def policy(self, name: str) -> int:
        """The index of a policy.

        Raises:
          ConfigError: if there is none of this name.
        """
        if name not in self.policies:
            raise ConfigError("policy", name, f"must be one of {', '.join(self.policies)}")
        return [*self.policies].index(name)


@pytree
class Faults:
    """When robots fail, in seconds from the start; infinite for never.

    Attributes:
      stops_at: `[R]` when the robot stops for good.
      blind_at: `[R]` when its sensor goes blind, unknown to the robot.
    """

    stops_at: jax.Array
    blind_at: jax.Array


@pytree
class Robots:
    """State of the robots, `[R]` each unless another shape is listed.

    Attributes:
      phase: int32, one of IDLE to FAILED.
      target: int32 PoI, or N for none.
      view: int32 viewpoint of the target, or V for the robot's current place.
      command: `[R, 2]` current speeds, see `navigation`.
      wanted: `[R, 2]` target speeds.
      decided_on: int32 version of the map at the last decision.
      excluded: `[R, V + 1]` bool viewpoints of the target that have failed.
      attempts: int32 failures at the target.
      way_left: metres left of the way at the last progress.
      progress_at: seconds, time of the last progress.
      backs_off_until: seconds.
      unreachable: `[R, N]` bool, PoIs given up without a way, or stuck on the last attempt; where
        there is a way they are taken back once, before the robot ends.
      undetected: `[R, N]` bool, PoIs given up after a last look that showed nothing.
      tried_again: bool, the robot has once taken back what it had given up where there is a way.
      goals: int32 viewpoints set out for and PoIs given up without a way, less the goals that a new
        decision made needless or another robot occupied.
      reached: int32 goals reached.
      looks: int32 scans.
      detections: int32 scans written into the map.
    """

    phase: jax.Array
    target: jax.Array
    view: jax.Array
    command: jax.Array
    wanted: jax.Array
    decided_on: jax.Array
    excluded: jax.Array
    attempts: jax.Array
    way_left: jax.Array
    progress_at: jax.Array
    backs_off_until: jax.Array
    unreachable: jax.Array
    undetected: jax.Array
    tried_again: jax.Array
    goals: jax.Array
    reached: jax.Array
    looks: jax.Array
    detections: jax.Array


@pytree
class MissionState:
    """One mission at one moment.

    Attributes:
      scene: PoIs, light and the robots' poses.
      classes: `[N]` int32 true classes, hidden from the robots.
      roadmap: ways through the layout.
      faults: which robots will fail.
      policy: `[]` int32 index into `Mission.policies`; by default `latent`, the trained one.
      velocity: `[R, 3]` time derivative of the poses.
      warmstart: `[3 R]` MJX's last accelerations.
      belief: `[N, D]` the shared map.
      log_posterior: `[N, C]` logarithms of the classes' probabilities by exact Bayes, for the
        policies `bayes` and `optimal`.
      times_seen: `[N, M]` int32, how often robots of each modality have written each PoI.
      version: `[]` int32, writes into the map so far.
      robots: their state.
      steps: `[]` int32 control periods so far.
      contacts: `[]` int32 control periods in which a robot touched something.
      least_clearance: `[]` smallest free distance around any robot so far, in metres.
      done: `[]` bool.
    """

    scene: Scene
    classes: jax.Array
    roadmap: Roadmap
    faults: Faults
    policy: jax.Array
    velocity: jax.Array
    warmstart: jax.Array
    belief: Belief
    log_posterior: jax.Array
    times_seen: jax.Array
    version: jax.Array
    robots: Robots
    steps: jax.Array
    contacts: jax.Array
    least_clearance: jax.Array
    done: jax.Array

    @property
    def seen(self) -> jax.Array:
        """`[..., N, M]` bool, which modalities have written which PoI."""
        return self.times_seen > 0


@pytree
class Record:
    """Record of one control period, for plots and tests.

    Attributes:
      time: `[]` seconds from the start, at its end.
      poses: `[R, 3]` at its end.
      command: `[R, 2]` at its end.
      wanted: `[R, 2]` in it.
      phase: `[R]`.
      target: `[R]`.
      scanned: `[R]` bool, the robot took a scan.
      detected: `[R]` bool, the scan was written into the map.
      belief: `[N, D]` the map.
      seen: `[N, M]` bool.
      clearance: `[]` smallest free distance around any robot in it, in metres.
    """

    time: jax.Array
    poses: jax.Array
    command: jax.Array
    wanted: jax.Array
    phase: jax.Array
    target: jax.Array
    scanned: jax.Array
    detected: jax.Array
    belief: Belief
    seen: jax.Array
    clearance: jax.Array


def make_mission(
    config: Config,
    policies: Mapping[str, Values | Policy] | None = None,
    *,
    contacts: bool = True,
    arenas: tuple[Arena, Arena] | None = None,
) -> Mission:
    """Makes a mission.

    Args:
      config: all settings; numbers that are declared `Traced` may be traced.
      policies: of your own, by name, besides `dqn.POLICIES`.
      contacts: whether robots collide with PoIs, with each other and with the walls.
      arenas: the arena and the empty arena of a mission with the same sizes, to reuse them; by
        default they are compiled, which cannot be traced.
    """
    carries_lidar = tuple(name == "lidar" for name in config.carried)
    world, free = (None, None) if arenas is None else arenas
    return Mission(
        world=worlds.make_world(config, config.carried, arena=world, contacts=contacts),
        free_arena=free or arenas_of.build(config.arena, carries_lidar, obstacles=False),
        config=config,
        policies=table(policies),
    )


def no_faults(config: Config) -> Faults:
    """Robots that never fail."""
    never = jnp.full(len(config.carried), jnp.inf)
    return Faults(never, never)


def reset(
    key: Key,
    mission: Mission,
    policy: jax.Array | int = 0,
    faults: Faults | None = None,
    classes: jax.Array | None = None,
) -> MissionState:
    """Starts a mission in a random arena with an empty map.

    Args:
      key: random key, which alone determines the arena.
      mission: the mission.
      policy: `[]` int32 index into `Mission.policies`; by default `latent`, the trained one.
      faults: which robots will fail; none by default.
      classes: `[N]` int32 classes of the PoIs; independent by default.

    Returns:
      The state. Robots stand at random places with room around them.
    """
    config = mission.config
    class_key, layout_key, light_key, pose_key = jax.random.split(key, 4)
    num_pois = config.arena.num_pois
    if classes is None:
        classes = jax.random.randint(class_key, (num_pois,), 0, len(config.arena.classes))
    layout = arenas_of.random_layout(layout_key, config.arena, classes)
    ways = roadmap.build(config, layout)
    poses = _random_poses(pose_key, config, layout, ways)
    scene = Scene(layout, sensors.random_light(light_key), poses)
    faults = no_faults(config) if faults is None else faults
    return start(mission, scene, classes, jnp.asarray(policy, jnp.int32), faults, ways)


def start(
    mission: Mission,
    scene: Scene,
    classes: jax.Array,
    policy: jax.Array,
    faults: Faults,
    ways: Roadmap | None = None,
) -> MissionState:
    """Starts a mission in a given arena with an empty map; see `reset` for the arguments."""
    config = mission.config
    num_robots, num_pois = len(config.carried), config.arena.num_pois
    num_classes = len(config.arena.classes)
    chex.assert_shape(classes, (num_pois,), custom_message="classes")
    checks.require_index("classes", classes, num_classes)
    checks.require_index("policy", policy, len(mission.policies))
    chex.assert_shape(scene.poses, (num_robots, 3), custom_message="scene.poses")
    _check_faults(faults, num_robots)
    prior, exact = make_prior(config), make_bayes(config)
    ways = roadmap.build(config, scene.layout) if ways is None else ways
    return MissionState(
        scene=scene,
        classes=classes,
        roadmap=ways,
        faults=faults,
        policy=policy,
        velocity=jnp.zeros((num_robots, 3)),
        warmstart=jnp.zeros(3 * num_robots),
        belief=jax.tree.map(lambda x: jnp.tile(x, (num_pois, 1)), prior),
        log_posterior=jnp.tile(exact.prior, (num_pois, 1)),
        times_seen=jnp.zeros((num_pois, len(config.modalities)), jnp.int32),
        version=jnp.int32(0),
        robots=_idle_robots(num_robots, *ways.is_free.shape),
        steps=jnp.int32(0),
        contacts=jnp.int32(0),
        least_clearance=jnp.float32(jnp.inf),
        done=jnp.bool_(False),
    )


def _check_faults(faults: Faults, num_robots: int) -> None:
    """Raises an error that names a time that does not fit the robots."""
    for name in ("stops_at", "blind_at"):
        times = getattr(faults, name)
        chex.assert_shape(times, (num_robots,), custom_message=f"faults.{name}")
        is_time = "must be seconds, infinite for never"
        checks.require(f"faults.{name}", times, lambda x: x >= 0, is_time)


def _idle_robots(num_robots: int, num_pois: int, num_views: int) -> Robots:
    """Robots before their first decision."""
    number = jnp.zeros(num_robots, jnp.int32)
    seconds = jnp.zeros(num_robots)
    return Robots(
        phase=number + IDLE,
        target=number + num_pois,
        view=number,
        command=jnp.zeros((num_robots, 2)),
        wanted=jnp.zeros((num_robots, 2)),
        decided_on=number,
        excluded=jnp.zeros((num_robots, num_views + 1), bool),
        attempts=number,
        way_left=seconds,
        progress_at=seconds,
        backs_off_until=seconds,
        unreachable=jnp.zeros((num_robots, num_pois), bool),
        undetected=jnp.zeros((num_robots, num_pois), bool),
        tried_again=jnp.zeros(num_robots, bool),
        goals=number,
        reached=number,
        looks=number,
        detections=number,
    )


def _random_poses(key: Key, config: Config, layout: arenas_of.Layout, ways: Roadmap) -> jax.Array:
    """Random `[R, 3]` poses with room around the robots and, where possible, ways to all PoIs."""
    num_robots, settings = len(config.carried), config.navigation
    draws = jax.random.uniform(key, (num_robots, 3, _FREE_DRAWS), minval=-1.0)
    reach = config.arena.side / 2 - settings.robot_radius
    places = reach * jnp.swapaxes(draws[:, :2], 1, 2)

    def room_at(place: jax.Array) -> jax.Array:
        to_pois = jnp.linalg.norm(layout.position - place[None], axis=-1)
        room = jnp.min(to_pois) - config.arena.poi_extent - settings.robot_radius
        # From a corner behind a PoI there may be no way out.
        has_ways = jnp.all(roadmap.reaches(config, layout, ways, place))
        return jnp.where(has_ways, room, room - config.arena.side)

    def place_robot(taken: jax.Array, robot: jax.Array) -> tuple[jax.Array, jax.Array]:
        apart = jnp.linalg.norm(places[robot][:, None] - taken[None], axis=-1)
        beside = jnp.min(apart, axis=-1) - 3 * settings.robot_radius
        free = jnp.minimum(room[robot], beside)
        chosen = jnp.where(jnp.any(free > 0), jnp.argmax(free > 0), jnp.argmax(free))
        place = places[robot, chosen]
        return taken.at[robot].set(place), jnp.append(place, jnp.pi * draws[robot, 2, chosen])

    room = jax.vmap(jax.vmap(room_at))(places)
    nowhere = jnp.full((num_robots, 2), jnp.inf)
    return jax.lax.scan(place_robot, nowhere, jnp.arange(num_robots))[1]


def robot_of(state: MissionState, robot: Index) -> Robots:
    """State of one robot: the fields of `Robots` without their first axis."""
    return jax.tree.map(lambda x: x[robot], state.robots)


def with_robot(state: MissionState, robot: Index, before: Robots, after: Robots) -> MissionState:
    """Replaces one robot, `before` from `robot_of`, by `after`."""

    def put(rows: jax.Array, old: jax.Array, new: jax.Array) -> jax.Array:
        return rows if new is old else rows.at[robot].set(new)

    return dataclasses.replace(state, robots=jax.tree.map(put, state.robots, before, after))


def now(mission: Mission, state: MissionState) -> jax.Array:
    """Seconds since the start, `[]`."""
    return state.steps * mission.config.mission.control_period
