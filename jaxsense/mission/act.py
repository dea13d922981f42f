"""Driving to a viewpoint, turning to the PoI, scanning it, and updating the map."""

import dataclasses
import functools
from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Shaped
from mujoco import mjx

from jaxsense.config.mission import CONTROL_PERIOD, Search
from jaxsense.core.types import Index, Key, call, others, pytree
from jaxsense.mission import navigation, roadmap
from jaxsense.mission.decide import AT_VIEWPOINT, RECOVERY_TIME, is_taken, sees
from jaxsense.mission.maps import Evidence, Learned
from jaxsense.mission.state import (
    ATTEMPTS,
    BACKING,
    DRIVING,
    ENDED,
    FACING,
    IDLE,
    RECENT_LOOKS,
    Mission,
    MissionState,
    Robots,
)
from jaxsense.models import Models
from jaxsense.sim import arena as arenas
from jaxsense.sim import localisation, viewpoints, windows
from jaxsense.sim import world as worlds

GOAL_ANGLE = 6.0  # degrees, maximum angle to the PoI at which a robot scans it
STUCK_TIME = 6.0  # s without progress, then a robot backs off and tries another viewpoint
_GOAL_DISTANCE = 0.2  # m, at which a viewpoint counts as reached if a look from there is new
_PROGRESS = 0.02  # m, minimum shortening of a path that counts as progress
_PATIENCE = 2.0  # s without progress of another robot, then one that has ended makes room
_NEARBY = 1.0  # m, between the centres of two robots
_TURNS_SLOWLY = 0.35  # rad/s, fastest turn at which a robot scans
_MIN_ROWS = 8  # of a group; on a CPU, fewer take as long
_NO_KIND = jnp.iinfo(jnp.int32).max

Row = TypeVar("Row")
Result = TypeVar("Result")


@pytree
class Course:
    """Where a robot wants to move.

    Attributes:
      waypoint: where its path leads next, in metres.
      bearing: of its target, see `viewpoints.bearing`.
    """

    phase: Int[Array, ""]
    waypoint: Float[Array, "2"]
    bearing: Float[Array, ""]
    makes_room: Bool[Array, ""]


@jax.named_scope("mission.approach")
def approach(
    mission: Mission, models: Models, state: MissionState, robot: Index
) -> tuple[MissionState, Course]:
    """Is on its way to the viewpoint, turns to the PoI, and backs off without progress.

    A robot need not get to the viewpoint itself if a look from nearby is new.

    Returns:
      The next state, and where the robot wants to move, see `steer`.
    """
    config, own = mission.config, state.robot(robot)
    num_views = state.roadmap.viewpoints.shape[1]
    poi, view = _target(mission, own), jnp.minimum(own.view, num_views - 1)
    position, standing = state.believed_poses[robot, :2], state.standing_robots(robot)
    length, waypoint = roadmap.next_waypoint(
        config, state.scene.layout, state.roadmap, own.to_view, position, standing, poi, view
    )
    to_goal = jnp.linalg.norm(state.roadmap.viewpoints[poi, view] - position)
    is_here = own.view == num_views
    modality = mission.modalities[robot]
    apart = mission.map_of(state, robot).apart(position[None], poi, modality)[0]
    to_go = models.novelty.to_go(apart, modality)
    is_near = to_goal <= jnp.where(to_go > 0, AT_VIEWPOINT, _GOAL_DISTANCE)
    is_there = is_here | (is_near & sees(mission, state, robot, poi))

    time, is_driving = mission.time(state), own.phase == DRIVING
    arrives = is_driving & is_there
    # The viewpoint is occupied or blocked by another robot: not a failure.
    is_blocked = is_driving & ~is_there & is_taken(mission, state, robot, poi, view)
    progresses = is_driving & (length < own.path_left - _PROGRESS)
    is_stuck = is_driving & ~is_there & ~is_blocked & ~progresses
    is_stuck &= time - own.progress_at > STUCK_TIME
    is_back = (own.phase == BACKING) & (time >= own.backs_off_until)

    attempts, excluded, gives_up = _fail(own, is_stuck)
    phase = jnp.select(
        [arrives, is_blocked, is_stuck, is_back], [FACING, IDLE, BACKING, IDLE], own.phase
    )
    makes_room = (phase == ENDED) & _is_in_the_way(mission, state, robot)
    makes_room &= time < state.faults.stops_at[robot]
    blocked = excluded.at[own.view].set(True)
    course = Course(phase, waypoint, _bearing(mission, state, robot), makes_room)
    state = state.with_robot(
        robot,
        phase=phase,
        attempts=attempts,
        unreachable=own.unreachable | gives_up,
        goals=own.goals - is_blocked,
        reached=own.reached + (arrives & ~is_here),
        excluded=jnp.where(is_blocked, blocked, excluded),
        path_left=jnp.where(progresses, length, own.path_left),
        progress_at=jnp.where(progresses | arrives, time, own.progress_at),
        backs_off_until=jnp.where(is_stuck, time + RECOVERY_TIME, own.backs_off_until),
    )
    return state, course


def _target(mission: Mission, own: Robots) -> Int[Array, ""]:
    """A robot's target; the last PoI if it has none, so that an index is valid."""
    return jnp.minimum(own.target, mission.config.arena.num_pois - 1)


@jax.named_scope("mission.steer")
def steer(mission: Mission, state: MissionState, robot: Index, course: Course) -> Float[Array, "2"]:
    """Speeds that a robot wants: along its path, backing off, or turning.

    It senses where obstacles are, but has to trust its own pose for where the waypoint is.
    """
    config, scene, phase = mission.config, state.scene, course.phase
    aim = localisation.aimed_at(course.waypoint, scene.poses[robot], state.pose_error[robot])
    drive = navigation.drive_to(
        config.arena,
        scene.layout,
        scene.poses,
        state.robots.command,
        robot,
        aim,
        CONTROL_PERIOD,
        backs_off=(phase == BACKING) | course.makes_room,
    )
    turn = navigation.face(course.bearing)
    is_driving = (phase == DRIVING) | (phase == BACKING) | course.makes_room
    return jnp.where(is_driving, drive, jnp.where(phase == FACING, turn, 0.0))


def _bearing(mission: Mission, state: MissionState, robot: Index) -> Float[Array, ""]:
    """Angle from a robot's heading to its target, as it believes, from -pi to pi radians."""
    poi = _target(mission, state.robot(robot))
    return viewpoints.bearing(state.believed_poses[robot], state.scene.layout.position[poi])


def _is_in_the_way(mission: Mission, state: MissionState, robot: Index) -> Bool[Array, ""]:
    """Whether another robot nearby drives without progress, or backs off."""
    robots, poses = state.robots, state.believed_poses
    waits = mission.time(state) - robots.progress_at > _PATIENCE
    needs_room = (robots.phase == BACKING) | ((robots.phase == DRIVING) & waits)
    is_near = jnp.linalg.norm(poses[:, :2] - poses[robot][None, :2], axis=-1) < _NEARBY
    return jnp.any(others(needs_room & is_near, robot))


def _fail(
    own: Robots, applies: Bool[Array, ""]
) -> tuple[Int[Array, ""], Bool[Array, " W"], Bool[Array, " N"]]:
    """New `attempts` and `excluded` of a robot after a failure, and which PoI it gives up."""
    failures = own.attempts + applies
    excluded = jnp.where(applies, own.excluded.at[own.view].set(True), own.excluded)
    is_target = jnp.arange(own.unreachable.shape[0]) == own.target
    return failures, excluded, applies & (failures >= ATTEMPTS) & is_target


@pytree
class _Aim:
    """Whether a robot scans, and which PoI, at which believed bearing [rad] and distance [m]."""

    scans: Bool[Array, ""]
    poi: Int[Array, ""]
    bearing: Float[Array, ""]
    distance: Float[Array, ""]
    noise_key: Key
    message_key: Key


@jax.named_scope("mission.scan")
def scan(
    keys: Key,
    mission: Mission,
    models: Models,
    states: MissionState,
    robot: Index,
) -> MissionState:
    """Scans the PoI that a robot faces, and updates the map, in B missions side by side."""
    aims = jax.vmap(lambda key, state: _aim(key, mission, state, robot))(keys, states)
    of_robot = mission.config.modality_of_robot
    carried = sorted(set(of_robot))
    which = jnp.array([carried.index(modality) for modality in of_robot])[robot]

    def look(rows: tuple[MissionState, _Aim], _) -> tuple[Bool[Array, " S"], Learned]:
        states, aims = rows
        place = lambda scene: arenas.place(mission.world.arena, scene.layout, scene.poses)  # noqa: E731
        placed = jax.vmap(place)(states.scene)
        look_with = lambda i: jax.vmap(  # noqa: E731
            functools.partial(_look, mission, models, robot, carried[i])
        )(states, aims, placed)
        # The choice of the sensor outside the batch: inside, all would scan.
        return call(look_with, which, len(carried))

    # Rows that are not due; any content will do, since it is not written.
    belief, log_posterior = jax.tree.map(lambda x: x[:, 0], (states.belief, states.log_posterior))
    evidence = None if states.memory is None else Evidence(log_posterior, log_posterior)
    nothing = jnp.zeros(len(keys), bool), Learned(belief, log_posterior, evidence)
    looks = where_due(aims.scans & ~states.done, look, nothing, (states, aims))
    return jax.vmap(functools.partial(_write, mission, robot))(states, aims, *looks)


@jax.named_scope("mission.aim")
def _aim(key: Key, mission: Mission, state: MissionState, robot: Index) -> _Aim:
    """Decides whether a robot scans, and what."""
    config, scene, own = mission.config, state.scene, state.robot(robot)
    error_key, noise_key, message_key = jax.random.split(key, 3)
    poi, bearing = _target(mission, own), _bearing(mission, state, robot)
    is_aligned = jnp.abs(bearing) <= jnp.radians(GOAL_ANGLE)
    is_calm = jnp.abs(own.command[1]) <= _TURNS_SLOWLY
    # It waits for a robot that drives through the view, but not for long.
    positions = state.believed_poses[:, :2]
    position, beside = positions[robot], others(positions, robot)
    room = viewpoints.free_room(
        position[:1], position[1:], 0.0, config.arena, scene.layout, beside, poi
    )
    waits = mission.time(state) - own.progress_at
    is_ready = is_aligned & is_calm & ((room[0] > 0) | (waits > STUCK_TIME))
    error = jnp.radians(config.viewpoint.bearing_error)
    return _Aim(
        scans=(own.phase == FACING) & is_ready,
        poi=poi,
        bearing=bearing + jax.random.uniform(error_key, (), minval=-error, maxval=error),
        distance=jnp.linalg.norm(scene.layout.position[poi] - position),
        noise_key=noise_key,
        message_key=message_key,
    )


@jax.named_scope("mission.look")
def _look(
    mission: Mission,
    models: Models,
    robot: Index,
    modality: int,
    state: MissionState,
    aim: _Aim,
    placed: mjx.Data,
) -> tuple[Bool[Array, ""], Learned]:
    """Whether a scan detects its PoI with enough confidence, and what it would change."""
    world, scene, sensor = mission.world, state.scene, mission.world.sensors[modality]
    search = Search(*mission.config.mission.localisation.search)
    wide = tuple(windows.widened(each, search) for each in world.sensors)
    world = dataclasses.replace(world, sensors=wide)
    time, bearing = mission.time(state), aim.bearing
    readings = worlds.scan_around(
        aim.noise_key, world, scene, placed, robot, bearing, modality, time
    )
    readings = jnp.where(time >= state.faults.blind_at[robot], sensor.blind, readings)
    found = models.detect_in_window(modality, sensor, readings, aim.bearing, aim.distance, search)
    is_confident = jnp.max(found.features) >= mission.config.mission.least_confidence
    known = mission.map_of(state, robot)
    apart = known.apart(state.believed_poses[robot, :2][None], aim.poi, modality)[0]
    weight = models.novelty.weight(apart, modality)
    learned = known.learn(models, aim.poi, found.features, modality, weight)
    return found.is_there & is_confident, learned


@jax.named_scope("mission.write")
def _write(
    mission: Mission,
    robot: Index,
    state: MissionState,
    aim: _Aim,
    detects: Bool[Array, ""],
    learned: Learned,
) -> MissionState:
    """Records a scan; if it detects the PoI, updates the map and tells the other robots."""
    poi, detects = aim.poi, aim.scans & detects
    modality = mission.modalities[robot]
    own = state.robot(robot)
    attempts, excluded, gives_up = _fail(own, aim.scans & ~detects)
    state = state.with_robot(
        robot,
        attempts=attempts,
        excluded=excluded,
        undetected=own.undetected | gives_up,
        phase=jnp.where(aim.scans, IDLE, own.phase),
        # After a detection the same PoI is a new target.
        target=jnp.where(detects, mission.config.arena.num_pois, own.target),
        looks=own.looks + aim.scans,
        detections=own.detections + detects,
    )
    belief, log_posterior = jax.tree.map(
        lambda rows, new: rows.at[poi].set(jnp.where(detects, new, rows[poi])),
        (state.belief, state.log_posterior),
        (learned.belief, learned.log_posterior),
    )
    number = state.times_seen[poi, modality] % RECENT_LOOKS
    position, memory = state.believed_poses[robot, :2], state.memory
    place = jnp.where(detects, position, state.looked_from[poi, modality, number])
    if memory is not None and learned.evidence is not None:
        time, settings = mission.time(state), mission.config.mission.communication
        memory = memory.with_look(robot, poi, position, learned.evidence, time, detects)
        sends = detects & (jnp.arange(len(memory.number)) == robot)
        memory = memory.after_messages(aim.message_key, settings, time, sends)
    return dataclasses.replace(
        state,
        looked_from=state.looked_from.at[poi, modality, number].set(place),
        belief=belief,
        log_posterior=log_posterior,
        times_seen=state.times_seen.at[poi, modality].add(detects),
        version=state.version + detects,
        memory=memory,
    )


@jax.named_scope("mission.where_due")
def where_due(
    due: Bool[Array, " B"],
    function: Callable[[Row, Int[Array, ""]], Result],
    before: Result,
    inputs: Row,
    kinds: Int[Array, " B"] | None = None,
) -> Result:
    """Applies a function to the rows of a batch that are due, one group of rows after another.

    The rows of a group are of one kind, so that the function can branch on it: a `lax.switch`
    inside a `vmap` would take all branches. Under a `vmap`, so does this function.

    Args:
      kinds: `[B]` int32, one kind by default.
    """
    of_row = jnp.zeros(len(due), jnp.int32) if kinds is None else kinds
    total, number = len(due), jnp.sum(due)
    size = min(total, max(_MIN_ROWS, total // 16))
    order = jnp.argsort(jnp.where(due, of_row, _NO_KIND))

    def rows_of(x: Shaped[Array, "B ..."], row: Int[Array, " S"]) -> Shaped[Array, "S ..."]:
        return x.at[row].get(mode="promise_in_bounds", wrap_negative_indices=False)

    def advance(carry: tuple[jax.Array, Result]) -> tuple[jax.Array, Result]:
        first, after = carry
        index = first + jnp.arange(size)
        row = rows_of(order, jnp.minimum(index, total - 1))
        kind_of = jnp.where(index < number, rows_of(of_row, row), _NO_KIND)
        kind = kind_of[0]
        is_new = kind_of == kind
        new = function(jax.tree.map(lambda x: rows_of(x, row), inputs), kind)
        kept = jnp.where(is_new, row, total)  # drops the others

        def put(x: Shaped[Array, "B ..."], new: Shaped[Array, "S ..."]) -> Shaped[Array, "B ..."]:
            return x.at[kept].set(new, mode="drop", wrap_negative_indices=False)

        return first + jnp.sum(is_new), jax.tree.map(put, after, new)

    some_left = lambda carry: carry[0] < number  # noqa: E731
    return jax.lax.while_loop(some_left, advance, (jnp.int32(0), before))[1]
