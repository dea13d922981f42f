"""Getting to a viewpoint, turning to the PoI, scanning it, and writing the map."""

import dataclasses

import jax
import jax.numpy as jnp

from jaxsense.mission.decide import planning_margin, sees, standing_robots
from jaxsense.mission.state import (
    BACKING,
    DRIVING,
    ENDED,
    FACING,
    IDLE,
    Mission,
    MissionState,
    now,
    update_robot,
)
from jaxsense.models import Models, make_jmvae
from jaxsense.sim import arena as arenas
from jaxsense.sim import navigation, roadmap, sensors, viewpoints
from jaxsense.sim import world as worlds
from jaxsense.sim.world import Scene
from jaxsense.types import Belief, Index, Key, call, others, pytree
from jaxsense.vae import detectors, fusion

_PROGRESS = 0.02  # m, by which a way must become shorter to count as progress
_PATIENCE = 2.0  # s without progress of another robot, after which one that has ended makes room
_NEARBY = 1.0  # m, between their middles
_TURNS_SLOWLY = 0.35  # rad/s, at which a robot may scan


def approach(mission: Mission, state: MissionState, robot: Index) -> MissionState:
    """Drives to the viewpoint, turns to the PoI, and backs off where there is no progress."""
    config, robots, scene = mission.config, state.robots, state.scene
    settings, period = config.navigation, config.mission.control_period
    time = now(mission, state)
    phase, view = robots.phase[robot], robots.view[robot]
    num_views = state.roadmap.viewpoints.shape[1]
    poi = jnp.minimum(robots.target[robot], config.arena.num_pois - 1)
    pose = scene.poses[robot]

    goal, standing = jnp.minimum(view, num_views - 1), standing_robots(state, robot)
    way_left, waypoint = roadmap.next_place(
        config,
        scene.layout,
        state.roadmap,
        pose[:2],
        standing,
        poi,
        goal,
    )
    place = state.roadmap.viewpoints[poi, goal]
    is_near = jnp.linalg.norm(place - pose[:2]) <= settings.goal_distance
    is_there = (view == num_views) | (is_near & sees(mission, state, robot, poi))
    arrives = (phase == DRIVING) & is_there
    # Another robot has come to stand there or in the view; that is nobody's failure.
    margin = planning_margin(config)
    room = viewpoints.free_room(
        place[:1], place[1:], margin, config.arena, scene.layout, standing, poi
    )
    is_taken = (phase == DRIVING) & ~is_there & (room[0] <= 0)

    progresses = (phase == DRIVING) & (way_left < robots.way_left[robot] - _PROGRESS)
    waits = time - robots.progress_at[robot]
    is_stuck = (phase == DRIVING) & ~is_there & ~is_taken & ~progresses
    is_stuck &= waits > settings.stuck_time
    state = _fail(state, robot, is_stuck, "unreachable", config.mission.attempts)
    robots = state.robots
    is_back = (phase == BACKING) & (time >= robots.backs_off_until[robot])
    cases = [arrives, is_taken, is_stuck, is_back]
    phase = jnp.select(cases, [FACING, IDLE, BACKING, IDLE], phase)
    excluded = robots.excluded[robot]

    makes_room = (phase == ENDED) & _is_in_the_way(mission, state, robot)
    makes_room &= time < state.faults.stops_at[robot]
    drive = navigation.drive_to(
        settings,
        config.arena,
        scene.layout,
        scene.poses,
        robots.command,
        robot,
        waypoint,
        period,
        backs_off=(phase == BACKING) | makes_room,
    )
    turn = navigation.face(_bearing(scene, robot, poi))
    is_driving = (phase == DRIVING) | (phase == BACKING) | makes_room
    wanted = jnp.where(is_driving, drive, jnp.where(phase == FACING, turn, 0.0))
    return update_robot(
        state,
        robot,
        phase=phase,
        wanted=wanted,
        goals=robots.goals[robot] - is_taken,
        reached=robots.reached[robot] + (arrives & (view < num_views)),
        excluded=jnp.where(is_taken, excluded.at[view].set(True), excluded),
        way_left=jnp.where(progresses, way_left, robots.way_left[robot]),
        progress_at=jnp.where(progresses | arrives, time, robots.progress_at[robot]),
        backs_off_until=jnp.where(
            is_stuck, time + settings.recovery_time, robots.backs_off_until[robot]
        ),
    )


def _is_in_the_way(mission: Mission, state: MissionState, robot: Index) -> jax.Array:
    """`[]` bool: a robot nearby drives and makes no progress."""
    robots, poses = state.robots, state.scene.poses
    waits = now(mission, state) - robots.progress_at > _PATIENCE
    is_near = jnp.linalg.norm(poses[:, :2] - poses[robot][None, :2], axis=-1) < _NEARBY
    return jnp.any(others((robots.phase == DRIVING) & waits & is_near, robot))


def _fail(
    state: MissionState, robot: Index, applies: jax.Array, given_up_as: str, attempts: int
) -> MissionState:
    """Notes that a viewpoint has failed; after some attempts the robot gives its target up."""
    robots = state.robots
    failures = robots.attempts[robot] + applies
    gives_up = applies & (failures >= attempts)
    given_up = getattr(robots, given_up_as)[robot]
    excluded = robots.excluded[robot]
    return update_robot(
        state,
        robot,
        attempts=failures,
        excluded=jnp.where(applies, excluded.at[robots.view[robot]].set(True), excluded),
        **{
            given_up_as: jnp.where(
                gives_up, given_up.at[robots.target[robot]].set(True, mode="drop"), given_up
            )
        },
    )


@pytree
class _Aim:
    """What a robot is about to scan.

    Attributes:
      scans: `[]` bool, whether it scans at all.
      poi: `[]` int32 which it faces.
      bearing: `[]` of the PoI as the robot believes it, in radians.
      distance: `[]` of the PoI, in metres.
      noise_key: random key of the sensor's noise.
    """

    scans: jax.Array
    poi: jax.Array
    bearing: jax.Array
    distance: jax.Array
    noise_key: Key


def scan(
    keys: Key, mission: Mission, models: Models, states: MissionState, robot: Index
) -> MissionState:
    """Takes a scan of the PoI that a robot faces, and writes what it shows into the map.

    Args:
      keys: `[B]` random keys.
      mission: the mission.
      models: trained networks.
      states: `[B]` missions side by side.
      robot: index of the robot, the same in all of them.

    Returns:
      The `[B]` states after it.
    """
    aims = jax.vmap(lambda key, state: _aim(key, mission, state, robot))(keys, states)

    def look(robot: int) -> tuple[jax.Array, Belief]:
        return jax.vmap(lambda state, aim: _look(mission, models, state, aim, robot))(states, aims)

    # The choice of the sensor outside the batch: inside, it would be traced over and over.
    is_seen, entries = call(look, robot, len(mission.world.sensors))
    write = jax.vmap(
        lambda state, aim, seen, entry: _write(mission, state, aim, seen, entry, robot)
    )
    return write(states, aims, is_seen, entries)


def _aim(key: Key, mission: Mission, state: MissionState, robot: Index) -> _Aim:
    """Whether a robot scans, and what."""
    config, scene, robots = mission.config, state.scene, state.robots
    error_key, noise_key = jax.random.split(key)
    poi = jnp.minimum(robots.target[robot], config.arena.num_pois - 1)
    bearing = _bearing(scene, robot, poi)
    is_aligned = jnp.abs(bearing) <= jnp.radians(config.navigation.goal_angle)
    is_calm = jnp.abs(robots.command[robot, 1]) <= _TURNS_SLOWLY
    # A robot that drives through the view is waited for, but not for long.
    place = scene.poses[robot, :2]
    standing = others(scene.poses[:, :2], robot)
    room = viewpoints.free_room(
        place[:1], place[1:], 0.0, config.arena, scene.layout, standing, poi
    )
    waits = now(mission, state) - robots.progress_at[robot]
    is_ready = is_aligned & is_calm & ((room[0] > 0) | (waits > config.navigation.stuck_time))
    error = jnp.radians(config.viewpoint.bearing_error)
    return _Aim(
        scans=(robots.phase[robot] == FACING) & is_ready,
        poi=poi,
        bearing=bearing + jax.random.uniform(error_key, (), minval=-error, maxval=error),
        distance=jnp.linalg.norm(scene.layout.position[poi] - place),
        noise_key=noise_key,
    )


def _look(
    mission: Mission, models: Models, state: MissionState, aim: _Aim, robot: int
) -> tuple[jax.Array, Belief]:
    """`[]` bool whether the PoI is seen, and the entry that the map would get."""
    world, scene, sensor = mission.world, state.scene, mission.world.sensors[robot]
    data = arenas.place(world.arena, scene.layout, scene.poses)
    readings = worlds.scan_around(aim.noise_key, world, scene, data, robot, aim.bearing)
    is_blind = now(mission, state) >= state.faults.blind_at[robot]
    readings = jnp.where(is_blind, sensor.blind, readings)
    shows = sensors.shows_poi(sensor, readings, aim.bearing, aim.distance, mission.config.arena)
    features = detectors.detect(models.detectors[robot], sensors.as_window(sensor, readings))
    is_sure = jnp.max(features) >= mission.config.mission.least_confidence
    old = jax.tree.map(lambda x: x[aim.poi], state.belief)
    shape, seen = make_jmvae(mission.config), state.seen[aim.poi]
    return shows & is_sure, fusion.write(models.jmvae, shape, old, seen, features, robot)


def _write(
    mission: Mission,
    state: MissionState,
    aim: _Aim,
    is_seen: jax.Array,
    entry: Belief,
    robot: Index,
) -> MissionState:
    """Notes a scan, and writes the entry into the map if the PoI was seen."""
    poi, detects = aim.poi, aim.scans & is_seen
    state = _fail(state, robot, aim.scans & ~detects, "undetected", mission.config.mission.attempts)
    robots = state.robots
    state = update_robot(
        state,
        robot,
        phase=jnp.where(aim.scans, IDLE, robots.phase[robot]),
        # After a detection the same PoI is a new target.
        target=jnp.where(detects, mission.config.arena.num_pois, robots.target[robot]),
        looks=robots.looks[robot] + aim.scans,
        detections=robots.detections[robot] + detects,
    )
    return dataclasses.replace(
        state,
        belief=jax.tree.map(
            lambda map_, new: map_.at[poi].set(jnp.where(detects, new, map_[poi])),
            state.belief,
            entry,
        ),
        seen=state.seen.at[poi, robot].set(state.seen[poi, robot] | detects),
        version=state.version + detects,
    )


def _bearing(scene: Scene, robot: Index, poi: jax.Array) -> jax.Array:
    """`[]` angle from a robot's heading to a PoI, in radians within -pi and pi."""
    return viewpoints.bearing(scene.poses[robot], scene.layout.position[poi])
