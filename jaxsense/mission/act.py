"""Driving to a viewpoint, turning to the PoI, scanning it, and writing the map."""

import dataclasses

import jax
import jax.numpy as jnp

from jaxsense.core.types import Belief, Index, Key, call, others, pytree
from jaxsense.looks import features_of
from jaxsense.mission import navigation, roadmap
from jaxsense.mission.decide import sees, standing_robots
from jaxsense.mission.groups import where_due
from jaxsense.mission.state import (
    BACKING,
    DRIVING,
    ENDED,
    FACING,
    IDLE,
    Mission,
    MissionState,
    Robots,
    now,
    robot_of,
    with_robot,
)
from jaxsense.models import Models
from jaxsense.sim import arena as arenas
from jaxsense.sim import viewpoints, windows
from jaxsense.sim import world as worlds
from jaxsense.sim.world import Scene

GOAL_ANGLE = 6.0  # degrees, largest angle to the PoI at which a robot scans it
STUCK_TIME = 6.0  # s without progress, then a robot backs off and tries another viewpoint
RECOVERY_TIME = 1.0  # s that a robot backs off
_GOAL_DISTANCE = 0.2  # m, at which a viewpoint counts as reached if the PoI is in view
_PROGRESS = 0.02  # m, least shortening of a way that counts as progress
_PATIENCE = 2.0  # s without progress of another robot, then one that has ended makes room
_NEARBY = 1.0  # m, between their middles
_TURNS_SLOWLY = 0.35  # rad/s, fastest turn at which a robot scans


def approach(mission: Mission, state: MissionState, robot: Index) -> MissionState:
    """Drives to the viewpoint, turns to the PoI, and backs off without progress."""
    config, own = mission.config, robot_of(state, robot)
    way = _way(mission, state, robot, own)
    time, is_driving = now(mission, state), own.phase == DRIVING
    arrives = is_driving & way.is_there
    # Another robot now stands there or in the view, which counts as nobody's failure.
    is_taken = is_driving & ~way.is_there & way.is_taken
    progresses = is_driving & (way.length < own.way_left - _PROGRESS)
    waits = time - own.progress_at
    is_stuck = is_driving & ~way.is_there & ~is_taken & ~progresses
    is_stuck &= waits > STUCK_TIME
    is_back = (own.phase == BACKING) & (time >= own.backs_off_until)

    failed, gives_up = _fail(own, is_stuck, config.mission.attempts)
    after = dataclasses.replace(
        failed,
        phase=jnp.select(
            [arrives, is_taken, is_stuck, is_back], [FACING, IDLE, BACKING, IDLE], own.phase
        ),
        unreachable=own.unreachable | gives_up,
        goals=own.goals - is_taken,
        reached=own.reached + (arrives & ~way.is_here),
        excluded=jnp.where(is_taken, failed.excluded.at[own.view].set(True), failed.excluded),
        way_left=jnp.where(progresses, way.length, own.way_left),
        progress_at=jnp.where(progresses | arrives, time, own.progress_at),
        backs_off_until=jnp.where(is_stuck, time + RECOVERY_TIME, own.backs_off_until),
    )
    makes_room = (after.phase == ENDED) & _is_in_the_way(mission, state, robot)
    makes_room &= time < state.faults.stops_at[robot]
    wanted = _wanted(mission, state, robot, after.phase, way.waypoint, makes_room)
    return with_robot(state, robot, own, dataclasses.replace(after, wanted=wanted))


@pytree
class _Way:
    """The way of a robot to its viewpoint.

    Attributes:
      length: `[]` metres left.
      waypoint: `[2]` the next place on it, in metres.
      is_here: `[]` bool, the viewpoint is where the robot stands.
      is_there: `[]` bool, the robot has arrived.
      is_taken: `[]` bool, another robot stands there or in the view.
    """

    length: jax.Array
    waypoint: jax.Array
    is_here: jax.Array
    is_there: jax.Array
    is_taken: jax.Array


def _way(mission: Mission, state: MissionState, robot: Index, own: Robots) -> _Way:
    config, scene = mission.config, state.scene
    position, standing = scene.poses[robot, :2], standing_robots(state, robot)
    num_views = state.roadmap.viewpoints.shape[1]
    poi = jnp.minimum(own.target, config.arena.num_pois - 1)
    goal = jnp.minimum(own.view, num_views - 1)
    length, waypoint = roadmap.next_place(
        config, scene.layout, state.roadmap, position, standing, poi, goal
    )
    place = state.roadmap.viewpoints[poi, goal]
    is_near = jnp.linalg.norm(place - position) <= _GOAL_DISTANCE
    room = viewpoints.free_room(
        place[:1], place[1:], config.navigation.margin, config.arena, scene.layout, standing, poi
    )
    is_here = own.view == num_views
    is_there = is_here | (is_near & sees(mission, state, robot, poi))
    return _Way(length, waypoint, is_here, is_there, room[0] <= 0)


def _wanted(
    mission: Mission,
    state: MissionState,
    robot: Index,
    phase: jax.Array,
    waypoint: jax.Array,
    makes_room: jax.Array,
) -> jax.Array:
    """Speeds that a robot wants, `[2]`: along its way, backing off, or turning."""
    config, scene, own = mission.config, state.scene, robot_of(state, robot)
    drive = navigation.drive_to(
        config.navigation,
        config.arena,
        scene.layout,
        scene.poses,
        state.robots.command,
        robot,
        waypoint,
        config.mission.control_period,
        backs_off=(phase == BACKING) | makes_room,
    )
    poi = jnp.minimum(own.target, config.arena.num_pois - 1)
    turn = navigation.face(_bearing(scene, robot, poi))
    is_driving = (phase == DRIVING) | (phase == BACKING) | makes_room
    return jnp.where(is_driving, drive, jnp.where(phase == FACING, turn, 0.0))


def _is_in_the_way(mission: Mission, state: MissionState, robot: Index) -> jax.Array:
    """Whether a robot nearby drives without progress, `[]` bool."""
    robots, poses = state.robots, state.scene.poses
    waits = now(mission, state) - robots.progress_at > _PATIENCE
    is_near = jnp.linalg.norm(poses[:, :2] - poses[robot][None, :2], axis=-1) < _NEARBY
    return jnp.any(others((robots.phase == DRIVING) & waits & is_near, robot))


def _fail(own: Robots, applies: jax.Array, attempts: int) -> tuple[Robots, jax.Array]:
    """Records the failure of a viewpoint.

    Returns:
      The robot, and `[N]` bool, the target if the robot gives it up.
    """
    failures = own.attempts + applies
    gives_up = applies & (failures >= attempts)
    after = dataclasses.replace(
        own,
        attempts=failures,
        excluded=jnp.where(applies, own.excluded.at[own.view].set(True), own.excluded),
    )
    return after, gives_up & (jnp.arange(own.unreachable.shape[0]) == own.target)


@pytree
class _Aim:
    """The next scan of a robot.

    Attributes:
      scans: `[]` bool, whether it scans at all.
      poi: `[]` int32 PoI that it faces.
      bearing: `[]` believed bearing of the PoI, in radians.
      distance: `[]` of the PoI, in metres.
      noise_key: random key of the sensor's noise.
    """

    scans: jax.Array
    poi: jax.Array
    bearing: jax.Array
    distance: jax.Array
    noise_key: Key


def scan(
    keys: Key,
    mission: Mission,
    models: Models,
    states: MissionState,
    robot: Index,
    parts: int = 1,
) -> MissionState:
    """Scans the PoI that a robot faces, and writes the detection into the map.

    Args:
      keys: `[B]` random keys.
      mission: the mission.
      models: trained networks.
      states: `[B]` missions side by side.
      robot: index of the robot, the same in all of them.
      parts: see `groups.where_due`.

    Returns:
      The `[B]` states after it.
    """
    aims = jax.vmap(lambda key, state: _aim(key, mission, state, robot))(keys, states)

    of_robot = mission.config.modality_of_robot
    carried = sorted(set(of_robot))
    first_rows = jax.tree.map(lambda x: x[:, 0], (states.belief, states.log_posterior))
    nothing = jnp.zeros(len(keys), bool), *first_rows  # not seen, and so never written

    def look(i: int) -> tuple[jax.Array, Belief, jax.Array]:
        def scan_one(state: MissionState, aim: _Aim) -> tuple[jax.Array, Belief, jax.Array]:
            return _look(mission, models, robot, carried[i], state, aim)

        return where_due(aims.scans & ~states.done, scan_one, nothing, states, aims, parts=parts)

    # The choice of the sensor outside the batch: inside, it would be traced over and over.
    which = jnp.array([carried.index(modality) for modality in of_robot])[robot]
    is_seen, entries, posteriors = call(look, which, len(carried))

    def write(state: MissionState, aim: _Aim, seen: jax.Array, entry: Belief, posterior: jax.Array):
        return _write(mission, state, aim, seen, entry, posterior, robot)

    return jax.vmap(write)(states, aims, is_seen, entries, posteriors)


def _aim(key: Key, mission: Mission, state: MissionState, robot: Index) -> _Aim:
    """Whether a robot scans, and what."""
    config, scene, robots = mission.config, state.scene, state.robots
    error_key, noise_key = jax.random.split(key)
    poi = jnp.minimum(robots.target[robot], config.arena.num_pois - 1)
    bearing = _bearing(scene, robot, poi)
    is_aligned = jnp.abs(bearing) <= jnp.radians(GOAL_ANGLE)
    is_calm = jnp.abs(robots.command[robot, 1]) <= _TURNS_SLOWLY
    # It waits for a robot that drives through the view, but not for long.
    place = scene.poses[robot, :2]
    standing = others(scene.poses[:, :2], robot)
    room = viewpoints.free_room(
        place[:1], place[1:], 0.0, config.arena, scene.layout, standing, poi
    )
    waits = now(mission, state) - robots.progress_at[robot]
    is_ready = is_aligned & is_calm & ((room[0] > 0) | (waits > STUCK_TIME))
    error = jnp.radians(config.viewpoint.bearing_error)
    return _Aim(
        scans=(robots.phase[robot] == FACING) & is_ready,
        poi=poi,
        bearing=bearing + jax.random.uniform(error_key, (), minval=-error, maxval=error),
        distance=jnp.linalg.norm(scene.layout.position[poi] - place),
        noise_key=noise_key,
    )


def _look(
    mission: Mission,
    models: Models,
    robot: Index,
    modality: int,
    state: MissionState,
    aim: _Aim,
) -> tuple[jax.Array, Belief, jax.Array]:
    """Whether the PoI is seen, `[]` bool, and its new entry and `[C]` posterior if it is."""
    world, scene, sensor = mission.world, state.scene, mission.world.sensors[modality]
    data = arenas.place(world.arena, scene.layout, scene.poses)
    readings = worlds.scan_around(aim.noise_key, world, scene, data, robot, aim.bearing, modality)
    is_blind = now(mission, state) >= state.faults.blind_at[robot]
    readings = jnp.where(is_blind, sensor.blind, readings)
    error = jnp.radians(mission.config.viewpoint.bearing_error)
    arena = mission.config.arena
    shows = windows.shows_poi(sensor, readings, aim.bearing, aim.distance, arena, error)
    features = features_of(models.detectors[modality], sensor, readings)
    is_sure = jnp.max(features) >= mission.config.mission.least_confidence
    old = jax.tree.map(lambda x: x[aim.poi], state.belief)
    belief = models.fusion.update(old, state.seen[aim.poi], features, modality)
    posterior = models.bayes.update(state.log_posterior[aim.poi], features, modality)
    return shows & is_sure, belief, posterior


def _write(
    mission: Mission,
    state: MissionState,
    aim: _Aim,
    is_seen: jax.Array,
    entry: Belief,
    posterior: jax.Array,
    robot: Index,
) -> MissionState:
    """Records a scan, and writes its entry and posterior if the PoI was seen."""
    poi, detects = aim.poi, aim.scans & is_seen
    modality = jnp.array(mission.config.modality_of_robot)[robot]
    own = robot_of(state, robot)
    failed, gives_up = _fail(own, aim.scans & ~detects, mission.config.mission.attempts)
    after = dataclasses.replace(
        failed,
        undetected=own.undetected | gives_up,
        phase=jnp.where(aim.scans, IDLE, own.phase),
        # After a detection the same PoI is a new target.
        target=jnp.where(detects, mission.config.arena.num_pois, own.target),
        looks=own.looks + aim.scans,
        detections=own.detections + detects,
    )
    state = with_robot(state, robot, own, after)
    belief, log_posterior = jax.tree.map(
        lambda rows, new: rows.at[poi].set(jnp.where(detects, new, rows[poi])),
        (state.belief, state.log_posterior),
        (entry, posterior),
    )
    return dataclasses.replace(
        state,
        belief=belief,
        log_posterior=log_posterior,
        times_seen=state.times_seen.at[poi, modality].add(detects),
        version=state.version + detects,
    )


def _bearing(scene: Scene, robot: Index, poi: jax.Array) -> jax.Array:
    """Angle from a robot's heading to a PoI, `[]` radians within -pi and pi."""
    return viewpoints.bearing(scene.poses[robot], scene.layout.position[poi])
