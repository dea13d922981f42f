"""Driving to a viewpoint, turning to the PoI, scanning it, and updating the map."""

import dataclasses
import functools
from collections.abc import Callable
from typing import TypeAlias, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree, Shaped

from jaxsense.config.mission import CONTROL_PERIOD, Search
from jaxsense.core.types import Belief, Index, Key, call, others, pytree
from jaxsense.mission import maps, navigation
from jaxsense.mission.decide import AT_VIEWPOINT, RECOVERY_TIME, views
from jaxsense.mission.maps import Evidence
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
    Robot,
    Robots,
    rows_at,
)
from jaxsense.models import Models
from jaxsense.sim import arena as arenas
from jaxsense.sim import localisation, viewpoints, windows
from jaxsense.sim import world as worlds

GOAL_ANGLE = 6.0  # degrees, maximum angle to the PoI at which a robot scans it
_GOAL_DISTANCE = 0.2  # m, at which a viewpoint counts as reached after a failed look
# Times lie between control periods, so that the rounding of a program does not decide.
STUCK_TIME = 5.95  # s without progress, then a robot backs off and tries another viewpoint
_PROGRESS = 0.02  # m, minimum shortening of a path that counts as progress
_PATIENCE = 1.95  # s without progress of another robot, then one that has ended makes room
_NEARBY = 1.0  # m, between the centres of two robots
_TURNS_SLOWLY = 0.35  # rad/s, fastest turn at which a robot scans
_MIN_ROWS = 8  # of a group; on a CPU, fewer take as long
_NO_KIND = jnp.iinfo(jnp.int32).max
_WRITTEN = "robots", "belief", "log_posterior", "times_seen", "looked_from", "memory"  # by a scan

_Held: TypeAlias = tuple[Belief, Float[Array, "*S C"]]
"""What the map of all looks says of a PoI: its belief, and the same by exact Bayes."""

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
    """Driving to a viewpoint, turning to the PoI, and backing off without progress.

    A robot looks as soon as it sees the PoI from where a look is new; after a failure, from the
    viewpoint itself.

    Returns:
      The next state, and where the robot wants to move, see `steer`.
    """
    me = Robot(mission, state, robot)
    own, poi, paths = me.own, me.target, state.roadmap
    num_views = paths.viewpoints.shape[1]
    view = jnp.minimum(own.view, num_views - 1)
    length, waypoint = paths.next_waypoint(own.to_view, me.pose[:2], me.standing, poi, view)
    viewpoint = paths.viewpoints[poi, view]
    is_free, sees = views(me, poi, viewpoint[None])
    is_here = own.view == num_views
    apart = me.map.apart(me.pose[None, :2], poi, me.modality)[0]
    is_new = models.novelty.to_go(apart, me.modality) <= 0
    near = jnp.where(own.attempts == 0, jnp.inf, _GOAL_DISTANCE)
    reach = jnp.where(is_new, near, AT_VIEWPOINT)
    is_there = is_here | (sees & (jnp.linalg.norm(viewpoint - me.pose[:2]) <= reach))

    time, is_driving = state.time, own.phase == DRIVING
    arrives = is_driving & is_there
    # The viewpoint is occupied or blocked by another robot: not a failure.
    is_blocked = is_driving & ~is_there & ~is_free[0]
    progresses = is_driving & (length < own.path_left - _PROGRESS)
    is_stuck = is_driving & ~is_there & ~is_blocked & ~progresses
    is_stuck &= time - own.progress_at > STUCK_TIME
    is_back = (own.phase == BACKING) & (time >= own.backs_off_until)

    attempts, excluded, gives_up = _fail(own, is_stuck)
    phase = jnp.select(
        [arrives, is_blocked, is_stuck, is_back], [FACING, IDLE, BACKING, IDLE], own.phase
    )
    makes_room = (phase == ENDED) & _is_in_the_way(me) & (time < state.faults.stops_at[robot])
    course = Course(phase, waypoint, _bearing(me), makes_room)
    after = state.with_robot(
        robot,
        phase=phase,
        attempts=attempts,
        unreachable=own.unreachable | gives_up,
        goals=own.goals - is_blocked,
        reached=own.reached + (arrives & ~is_here),
        excluded=excluded | (is_blocked & (jnp.arange(num_views + 1) == own.view)),
        path_left=jnp.where(progresses, length, own.path_left),
        progress_at=jnp.where(progresses | arrives, time, own.progress_at),
        backs_off_until=jnp.where(is_stuck, time + RECOVERY_TIME, own.backs_off_until),
    )
    return after, course


@jax.named_scope("mission.steer")
def steer(mission: Mission, state: MissionState, robot: Index, course: Course) -> Float[Array, "2"]:
    """Speeds that a robot wants: along its path, backing off, making room, or turning.

    It senses where obstacles are, but has to trust its own pose for where the waypoint is.
    """
    poses, commands = state.scene.poses, state.robots.command
    arena, layout = mission.config.arena, state.scene.layout
    backs_off = (course.phase == BACKING) | course.makes_room
    aim = localisation.aimed_at(course.waypoint, poses[robot], state.pose_error[robot])
    drive = navigation.drive_to(
        arena, layout, poses, commands, robot, aim, CONTROL_PERIOD, backs_off
    )
    is_driving, turn = (course.phase == DRIVING) | backs_off, navigation.face(course.bearing)
    return jnp.where(is_driving, drive, jnp.where(course.phase == FACING, turn, 0.0))


def _bearing(me: Robot) -> Float[Array, ""]:
    """Angle from a robot's heading to its target, as it believes, from -pi to pi radians."""
    return viewpoints.bearing(me.pose, me.state.scene.layout.position[me.target])


def _is_in_the_way(me: Robot) -> Bool[Array, ""]:
    """Whether another robot nearby drives or faces a PoI without progress, or backs off."""
    robots, positions = me.state.robots, me.state.believed_poses[:, :2]
    waits = me.state.time - robots.progress_at > _PATIENCE
    is_at_work = (robots.phase == DRIVING) | (robots.phase == FACING)
    needs_room = (robots.phase == BACKING) | (is_at_work & waits)
    is_near = jnp.linalg.norm(positions - me.pose[None, :2], axis=-1) < _NEARBY
    return jnp.any(others(needs_room & is_near, me.index))


def _fail(
    own: Robots, applies: Bool[Array, ""]
) -> tuple[Int[Array, ""], Bool[Array, " W"], Bool[Array, " N"]]:
    """New `attempts` and `excluded` of a robot after a failure, and which PoI it gives up."""
    failures = own.attempts + applies
    excluded = own.excluded | (applies & (jnp.arange(len(own.excluded)) == own.view))
    is_target = jnp.arange(own.unreachable.shape[0]) == own.target
    return failures, excluded, applies & (failures >= ATTEMPTS) & is_target


@jax.named_scope("mission.scan")
def scan(
    keys: Key, mission: Mission, models: Models, states: MissionState, robot: Index
) -> MissionState:
    """Scans the PoI that a robot faces, and updates the map, in B missions side by side."""
    of_robot = mission.config.modality_of_robot
    carried = sorted(set(of_robot))
    which = jnp.array([carried.index(modality) for modality in of_robot])[robot]
    written = lambda states: {name: getattr(states, name) for name in _WRITTEN}  # noqa: E731

    def scanned(rows: tuple[Key, MissionState], _) -> dict[str, PyTree]:
        keys, states = rows
        keys = jax.vmap(lambda key: jax.random.split(key, 3), out_axes=1)(keys)

        def look(i: int) -> tuple[Bool[Array, " S"], _Held, Evidence | None]:
            alone = functools.partial(_look, mission, models, robot, carried[i])
            return jax.vmap(alone)(keys[0], keys[1], states)

        # The choice of the sensor outside the batch: inside, all would scan.
        found = call(look, which, len(carried))
        write = jax.vmap(functools.partial(_write, mission, robot))
        return written(write(keys[2], states, *found))

    scans = jax.vmap(lambda state: _scans(Robot(mission, state, robot)))(states)
    after = where_due(scans & ~states.done, scanned, written(states), (keys, states))
    return dataclasses.replace(states, **after)


@jax.named_scope("mission.scans")
def _scans(me: Robot) -> Bool[Array, ""]:
    """Whether a robot faces its target and scans it."""
    state, own, arena = me.state, me.own, me.mission.config.arena
    is_aligned = jnp.abs(_bearing(me)) <= jnp.radians(GOAL_ANGLE)
    is_calm = jnp.abs(own.command[1]) <= _TURNS_SLOWLY
    # It waits for a robot that drives through the view, but not for long.
    beside = others(state.believed_poses[:, :2], me.index)
    x, y = me.pose[:1], me.pose[1:2]
    room = viewpoints.free_room(x, y, 0.0, arena, state.scene.layout, beside, me.target)
    waits = state.time - own.progress_at > STUCK_TIME
    return (own.phase == FACING) & is_aligned & is_calm & ((room[0] > 0) | waits)


def _looks_at(key: Key, me: Robot) -> Float[Array, ""]:
    """Bearing at which a robot looks at its target, with a random error, in radians."""
    error = jnp.radians(me.mission.config.viewpoint.bearing_error)
    return _bearing(me) + jax.random.uniform(key, (), minval=-error, maxval=error)


@jax.named_scope("mission.look")
def _look(
    mission: Mission,
    models: Models,
    robot: Index,
    modality: int,
    bearing_key: Key,
    scan_key: Key,
    state: MissionState,
) -> tuple[Bool[Array, ""], _Held, Evidence | None]:
    """Whether a scan detects its PoI with enough confidence, and what it would change.

    Returns:
      Whether it detects it, what the map of all looks would say of it, and what the robot would
      remember of the look: None where all robots share a map.
    """
    config, sensor = mission.config, mission.world.sensors[modality]
    me, scene = Robot(mission, state, robot), state.scene
    bearing = _looks_at(bearing_key, me)
    distance = jnp.linalg.norm(scene.layout.position[me.target] - me.pose[:2])
    placed = arenas.place(mission.world.arena, scene.layout, scene.poses)
    search = Search(*config.mission.localisation.search)
    wide = tuple(windows.widened(each, search) for each in mission.world.sensors)
    world = dataclasses.replace(mission.world, sensors=wide)
    readings = worlds.scan_around(
        scan_key, world, scene, placed, robot, bearing, modality, state.time
    )
    readings = jnp.where(state.time >= state.faults.blind_at[robot], sensor.blind, readings)
    found = models.detect_in_window(modality, sensor, readings, bearing, distance, search)
    is_confident = jnp.max(found.features) >= config.mission.least_confidence
    apart = me.map.apart(me.pose[None, :2], me.target, me.modality)[0]
    look = found.features, modality, models.novelty.weight(apart, me.modality)
    before = state.belief, state.seen, state.log_posterior
    belief, seen, log_posterior = jax.tree.map(lambda rows: rows[me.target], before)
    held = models.fusion.update(belief, seen, *look), models.bayes.update(log_posterior, *look)
    evidence = None if state.memory is None else maps.evidence_of(models, *look)
    return found.is_there & is_confident, held, evidence


@jax.named_scope("mission.write")
def _write(
    mission: Mission,
    robot: Index,
    message_key: Key,
    state: MissionState,
    detects: Bool[Array, ""],
    held: _Held,
    evidence: Evidence | None,
) -> MissionState:
    """Records a scan; if it detects the PoI, updates the map and tells the other robots."""
    me = Robot(mission, state, robot)
    own, poi, modality = me.own, me.target, me.modality
    attempts, excluded, gives_up = _fail(own, ~detects)
    excluded = excluded.at[-1].set(excluded[-1] | ~detects)  # it has looked from where it stands
    belief, log_posterior = jax.tree.map(
        lambda rows, new: rows.at[poi].set(jnp.where(detects, new, rows[poi])),
        (state.belief, state.log_posterior),
        held,
    )
    number = state.times_seen[poi, modality] % RECENT_LOOKS
    position, memory = me.pose[:2], state.memory
    place = jnp.where(detects, position, state.looked_from[poi, modality, number])
    if memory is not None and evidence is not None:
        memory = memory.with_look(robot, poi, position, evidence, state.time, detects)
        sends = detects & (jnp.arange(len(memory.number)) == robot)
        settings = mission.config.mission.communication
        memory = memory.after_messages(message_key, settings, state.time, sends)
    return dataclasses.replace(
        state,
        looked_from=state.looked_from.at[poi, modality, number].set(place),
        belief=belief,
        log_posterior=log_posterior,
        times_seen=state.times_seen.at[poi, modality].add(detects),
        memory=memory,
    ).with_robot(
        robot,
        attempts=attempts,
        excluded=excluded,
        undetected=own.undetected | gives_up,
        phase=jnp.int32(IDLE),
        # After a detection the same PoI is a new target.
        target=jnp.where(detects, mission.config.arena.num_pois, own.target),
        looks=own.looks + 1,
        detections=own.detections + detects,
    )


@jax.named_scope("mission.where_due")
def where_due(
    due: Bool[Array, " B"],
    function: Callable[[Row, Int[Array, ""]], Result],
    before: Result,
    inputs: Row,
    kinds: Int[Array, " B"] | int = 0,
) -> Result:
    """Applies a function to the rows of a batch that are due, one group of rows after another.

    The rows of a group are of one kind, so that the function can branch on it: a `lax.switch`
    inside a `vmap` would take all branches. Under a `vmap`, so does this function.

    Args:
      kinds: of the rows; one kind by default.
    """
    total = len(due)
    size = min(total, max(_MIN_ROWS, total // 16))
    # All that follows reads the results of one sort: XLA may compute `due` once for each use, and a
    # row at a limit that rounds differently would be due in one place and not in another.
    due_kinds = jnp.where(due, kinds, _NO_KIND)
    due_kinds, order = jax.lax.sort_key_val(due_kinds, jnp.arange(total))
    number = jnp.sum(due_kinds != _NO_KIND)

    def advance(carry: tuple[jax.Array, Result]) -> tuple[jax.Array, Result]:
        first, after = carry
        index = first + jnp.arange(size)
        at = jnp.minimum(index, total - 1)
        row, kind_of = rows_at(order, at), rows_at(due_kinds, at)
        kind = kind_of[0]
        is_new = (index < total) & (kind_of == kind)
        new = function(jax.tree.map(lambda x: rows_at(x, row), inputs), kind)
        kept = jnp.where(is_new, row, total)  # drops the others

        def put(x: Shaped[Array, "B ..."], new: Shaped[Array, "S ..."]) -> Shaped[Array, "B ..."]:
            return x.at[kept].set(new, mode="drop", wrap_negative_indices=False)

        return first + jnp.sum(is_new), jax.tree.map(put, after, new)

    some_left = lambda carry: carry[0] < number  # noqa: E731
    return jax.lax.while_loop(some_left, advance, (jnp.int32(0), before))[1]
