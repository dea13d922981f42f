"""Missions in unknown places, as one scan over control periods."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from mujoco import mjx

from jaxsense.config.mission import CONTROL_PERIOD
from jaxsense.core import checks
from jaxsense.core.types import Index, Key, others, within_a_turn
from jaxsense.exploration import decide, proposals
from jaxsense.exploration import grid as grids
from jaxsense.exploration import slots as objects
from jaxsense.exploration.decide import Policy
from jaxsense.exploration.state import ExplorationState
from jaxsense.mission import navigation
from jaxsense.mission.act import STUCK_TIME, where_due
from jaxsense.mission.decide import RECOVERY_TIME
from jaxsense.mission.rollout import move
from jaxsense.mission.state import RECENT_LOOKS, Mission
from jaxsense.models import Models
from jaxsense.sim import amiro, viewpoints
from jaxsense.sim import arena as arenas
from jaxsense.sim import sensors as scanners

SENSING_PERIODS = 5
"""Control periods between two scans of a robot."""
_DECIDING_PERIODS = 20  # of control, after which a robot chooses anew
_NUM_CANDIDATES = 8
_REACH = 2.0  # m, within which scans show PoIs
_DETECTION, _CLUTTER = 0.9, 0.01  # of an object in view; false ones per scan and square metre
_SHOWN = 0.98  # probability that a look at an object shows it
_FACING = 20.0  # degrees, largest bearing of a look
_AT_GOAL = 0.1  # m
_TURNED = np.radians(10.0)  # rad, from the heading at a frontier
_PROGRESS = 0.05  # m, minimum shortening of the path that counts as progress


@checks.typed
def rollout_batch(
    keys: Key,
    mission: Mission,
    models: Models,
    policy: Policy,
    states: ExplorationState,
    steps: int,
) -> ExplorationState:
    """Runs B missions side by side for some control periods.

    Args:
      keys: `[B]`.
    """

    def go_on(states: ExplorationState, keys: Key):
        return step(keys, mission, models, policy, states), None

    step_keys = jax.vmap(lambda key: jax.random.split(key, steps), out_axes=1)(keys)
    return jax.lax.scan(go_on, states, step_keys)[0]


def step(
    keys: Key, mission: Mission, models: Models, policy: Policy, states: ExplorationState
) -> ExplorationState:
    """Runs one control period of B missions side by side: all robots sense, decide and move."""
    before, num_robots = states, mission.world.arena.num_robots
    sense_keys, choice_keys = jax.vmap(jax.random.split, out_axes=1)(keys)

    def sensed(rows: tuple[Key, ExplorationState], _) -> ExplorationState:
        return jax.vmap(lambda key, state: sense(key, mission, models, state))(*rows)

    due = (states.steps % SENSING_PERIODS == 0) & ~states.done
    states = where_due(due, sensed, states, (sense_keys, states))

    def decided(states: ExplorationState, robot: jax.Array):
        def chosen(rows: tuple[Key, ExplorationState], _) -> ExplorationState:
            alone = lambda key, state: decide.choose(key, mission, models, policy, state, robot)  # noqa: E731
            return jax.vmap(alone)(*rows)

        is_time = states.steps % _DECIDING_PERIODS == 0
        due = (is_time | states.robots.reconsiders[:, robot]) & ~states.done
        keys = jax.vmap(jax.random.fold_in, (0, None))(choice_keys, robot)
        return where_due(due, chosen, states, (keys, states)), None

    all_robots = jnp.arange(num_robots)
    for robot in range(num_robots):
        states = jax.vmap(_progressed, (0, None))(states, robot)
    states, _ = jax.lax.scan(decided, states, all_robots)
    steer_each = jax.vmap(functools.partial(steer, mission), (None, 0))
    wanted = jax.vmap(steer_each, (0, None))(states, all_robots)
    states = move(mission, states, wanted)
    nothing = len(before.slots.existence[0]) + decide.NUM_FRONTIERS
    is_over = jnp.all(states.robots.target == nothing, axis=-1) & (states.steps > 0)
    steps = states.steps + 1
    is_late = steps * CONTROL_PERIOD >= mission.config.mission.time_limit
    after = dataclasses.replace(states, steps=steps, done=is_over | is_late)
    keep = jax.vmap(jnp.where)
    return jax.tree.map(lambda x, y: keep(before.done, x, y), before, after)


def steer(mission: Mission, state: ExplorationState, robot: Index) -> Float[Array, "2"]:
    """Speeds that a robot wants: along its way, or turning to the object that it looks at.

    What is within reach of the next two seconds, its proximity sensors show.
    """
    poses, robots = state.scene.poses, state.robots
    pose = poses[robot]
    goal, backs_off = robots.goal[robot], state.time < robots.backs_off_until[robot]
    waypoint = grids.way(state.grid, robots.way[robot], pose[:2])
    drive = navigation.drive_to(
        mission.config.arena,
        state.scene.layout,
        poses,
        robots.command,
        robot,
        waypoint,
        CONTROL_PERIOD,
        backs_off,
    )
    turn = navigation.face(within_a_turn(goal[2] - pose[2]))
    return jnp.where(_is_there(state, robot) & ~backs_off, turn, drive)


def _is_there(state: ExplorationState, robot: Index) -> Bool[Array, ""]:
    """Whether a robot has arrived at its goal."""
    way = state.robots.goal[robot, :2] - state.scene.poses[robot, :2]
    return jnp.linalg.norm(way) < _AT_GOAL


def _progressed(state: ExplorationState, robot: Index) -> ExplorationState:
    """Notes whether a robot gets nearer to its goal; one that does not backs off, and reconsiders.

    A frontier is done with once the robot has turned to it.
    """
    robots, pose = state.robots, state.scene.poses[robot]
    left = decide.lengths_at(state.grid, robots.way[robot], pose[None, :2])[0]
    off = jnp.abs(within_a_turn(robots.goal[robot, 2] - pose[2]))
    there = _is_there(state, robot)
    progresses = left < robots.left[robot] - _PROGRESS
    is_stuck = ~there & ~progresses & (state.time - robots.progress_at[robot] > STUCK_TIME)
    ends = there & (robots.target[robot] >= len(state.slots.existence)) & (off < _TURNED)
    until = jnp.where(is_stuck, state.time + RECOVERY_TIME, robots.backs_off_until[robot])
    return state.with_robot(
        robot,
        left=jnp.where(progresses, left, robots.left[robot]),
        progress_at=jnp.where(progresses | there | is_stuck, state.time, robots.progress_at[robot]),
        backs_off_until=until,
        reconsiders=robots.reconsiders[robot] | is_stuck | ends,
    )


def sense(key: Key, mission: Mission, models: Models, state: ExplorationState) -> ExplorationState:
    """Lets all robots scan, one after the other, and updates floor, objects and beliefs."""
    placed = arenas.place(mission.world.arena, state.scene.layout, state.scene.poses)
    for robot, modality in enumerate(mission.config.modality_of_robot):
        key, own_key = jax.random.split(key)
        state = _sense(own_key, mission, models, state, placed, robot, modality)
    return state


def _sense(
    key: Key,
    mission: Mission,
    models: Models,
    state: ExplorationState,
    placed: mjx.Data,
    robot: int,
    modality: int,
) -> ExplorationState:
    """Scans with one robot; index and modality are static."""
    config, scene, sensor = mission.config, state.scene, mission.world.sensors[modality]
    pose, arena = scene.poses[robot], mission.world.arena
    seconds = state.steps * CONTROL_PERIOD
    readings = scanners.scan(
        key,
        sensor,
        arena,
        placed,
        scene.layout,
        scene.light,
        robot,
        sensor.directions,
        seconds=seconds,
    )
    beside = others(scene.poses[:, :2], robot)
    radii = jnp.full((len(beside), 1), 2 * amiro.BODY_RADIUS)
    candidates = proposals.propose(
        sensor,
        readings,
        pose,
        outer_walls(config.arena.side),
        jnp.concatenate([beside, radii], axis=1),
        config.arena.poi_radius,
        _NUM_CANDIDATES,
    )
    is_there = jax.vmap(
        lambda bearing, distance: models.detect(modality, sensor, readings, bearing, distance)
    )(candidates.bearing, candidates.distance).is_there
    in_range = candidates.distance <= config.viewpoint.max_distance
    in_range &= candidates.distance >= config.viewpoint.min_distance
    in_range &= jnp.abs(candidates.bearing) <= jnp.radians(_FACING)
    reach, radius = config.arena.side / 2, config.arena.poi_radius
    is_inside = jnp.max(jnp.abs(candidates.position), axis=-1) < reach - radius
    is_valid = candidates.is_valid & is_inside & (is_there | ~in_range)
    candidates = dataclasses.replace(candidates, is_valid=is_valid)
    slots = state.slots
    found = objects.associate(slots, candidates, radius)
    expected = _expected(mission, state, sensor, pose) & ~found.is_seen
    slots = objects.with_candidates(slots, candidates, found, _DETECTION, _CLUTTER)
    slots = objects.with_misses(models, slots, expected, _DETECTION)
    slots = objects.merged(models, slots, radius)
    floor = state.grid
    if sensor.measures_distance:
        used = jnp.where(slots.is_used[:, None], slots.position, jnp.inf)
        ignored = jnp.concatenate([used, beside])
        floor = grids.with_scan(
            floor, pose, sensor.angles, readings, config.lidar.max_range, ignored, modality, _REACH
        )
    else:
        view = jnp.radians(sensor.field_of_view)
        floor = grids.with_view(floor, pose, view, _REACH, modality)
    state = dataclasses.replace(state, slots=slots, grid=floor)
    return _look(mission, models, state, readings, robot, modality)


def outer_walls(side: float) -> Float[Array, "4 4"]:
    """The walls that robots know: from x and y to x and y, in metres."""
    corners = side / 2 * jnp.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])
    return jnp.concatenate([corners, jnp.roll(corners, -1, axis=0)], axis=1)


def _expected(
    mission: Mission, state: ExplorationState, sensor: scanners.Sensor, pose: Float[Array, "3"]
) -> Bool[Array, " S"]:
    """Slots that a scan shows if they hold an object: in view, in range and not covered."""
    slots, config = state.slots, mission.config
    bearing = jax.vmap(viewpoints.bearing, (None, 0))(pose, slots.position)
    distance = jnp.linalg.norm(slots.position - pose[None, :2], axis=-1)
    margin = jnp.radians(10.0)
    in_view = jnp.abs(bearing) < jnp.radians(sensor.field_of_view) / 2 - margin
    in_view &= (distance > config.viewpoint.min_distance) & (distance < _REACH)
    share = 1 - config.arena.poi_extent / jnp.maximum(distance, 1e-3)
    ends = pose[None, :2] + share[:, None] * (slots.position - pose[None, :2])
    is_clear = jax.vmap(decide.is_clear, (None, None, 0))(state.grid, pose[:2], ends)
    # Behind another object or robot nothing is expected.
    apart = jnp.abs(bearing[:, None] - bearing[None])
    is_nearer = distance[None] < distance[:, None]
    width = 2 * config.arena.poi_extent / jnp.maximum(distance, 0.1)
    covers = is_nearer & slots.is_used[None] & (apart < width[None])
    return slots.is_used & in_view & is_clear & ~jnp.any(covers, axis=1)


def _look(
    mission: Mission,
    models: Models,
    state: ExplorationState,
    readings: Float[Array, "B *channels"],
    robot: int,
    modality: int,
) -> ExplorationState:
    """Updates the belief of the robot's target, if it faces it, with what its scan says."""
    config, slots, robots = mission.config, state.slots, state.robots
    number = len(slots.existence)
    target = jnp.minimum(robots.target[robot], number - 1)
    pose, centre = state.scene.poses[robot], slots.position[target]
    bearing, distance = viewpoints.bearing(pose, centre), jnp.linalg.norm(centre - pose[:2])
    faces = (robots.target[robot] < number) & slots.is_used[target] & _is_there(state, robot)
    faces &= jnp.abs(bearing) < jnp.radians(_FACING)
    detection = models.detect(
        modality, mission.world.sensors[modality], readings, bearing, distance
    )
    is_confident = jnp.max(detection.features) >= config.mission.least_confidence
    detects = faces & detection.is_there & is_confident
    detects &= decide.can_look(mission, state, pose[:2], centre)
    apart = jnp.linalg.norm(slots.looked_from[target, modality] - pose[None, :2], axis=-1)
    look = detection.features, modality, models.novelty.weight(apart, modality)
    belief, seen, log_posterior = jax.tree.map(
        lambda rows: rows[target], (slots.belief, slots.times_seen > 0, slots.log_posterior)
    )
    new = models.fusion.update(belief, seen, *look), models.bayes.update(log_posterior, *look)
    belief, log_posterior = jax.tree.map(
        lambda rows, x: rows.at[target].set(jnp.where(detects, x, rows[target])),
        (slots.belief, slots.log_posterior),
        new,
    )
    at = slots.times_seen[target, modality] % RECENT_LOOKS
    # A place from which a look shows nothing is not tried again either.
    place = jnp.where(faces, pose[:2], slots.looked_from[target, modality, at])
    after = dataclasses.replace(
        slots,
        belief=belief,
        log_posterior=log_posterior,
        times_seen=slots.times_seen.at[target, modality].add(detects),
        looked_from=slots.looked_from.at[target, modality, at].set(place),
    )
    is_missed = faces & ~detection.is_there & (jnp.arange(number) == target)
    after = objects.with_misses(models, after, is_missed, _SHOWN)
    failed = state.failures[target, modality] + 1
    failures = jnp.where(detects, 0, failed) * faces + state.failures[target, modality] * ~faces
    failures = state.failures.at[target, modality].set(failures)
    failures = jnp.where(after.is_used[:, None], failures, 0)
    return dataclasses.replace(state, slots=after, failures=failures).with_robot(
        robot, looks=robots.looks[robot] + faces, reconsiders=robots.reconsiders[robot] | faces
    )
