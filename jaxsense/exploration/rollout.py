"""Missions in unknown places, as one scan over control periods."""

import dataclasses
import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from mujoco import mjx

from jaxsense.config.mission import CONTROL_PERIOD
from jaxsense.core import checks
from jaxsense.core.types import Index, Key, others, within_a_turn
from jaxsense.dqn.policies import Values
from jaxsense.exploration import decide, proposals
from jaxsense.exploration import grid as grids
from jaxsense.exploration import slots as objects
from jaxsense.exploration.proposals import Candidates
from jaxsense.exploration.slots import Association, Slots
from jaxsense.exploration.state import NUM_FRONTIERS, ExplorationState
from jaxsense.mission import navigation
from jaxsense.mission.act import STUCK_TIME, where_due
from jaxsense.mission.decide import RECOVERY_TIME
from jaxsense.mission.rollout import drifted, move
from jaxsense.mission.state import RECENT_LOOKS, Mission
from jaxsense.models import Models
from jaxsense.sim import amiro, localisation, viewpoints
from jaxsense.sim import arena as arenas
from jaxsense.sim import sensors as scanners

SENSING_PERIODS = 5
"""Control periods between two scans of a robot."""
_DECIDING_PERIODS = 20  # of control, after which a robot chooses anew
_NUM_CANDIDATES = 8
_DETECTION, _CLUTTER = 0.9, 0.01  # of an object in view; false ones per scan and square metre
_SHOWN = 0.98  # probability that a look at an object shows it
_RIM = 10.0  # degrees, at the rim of a scan, where it may cut a PoI
_NEAR = 0.3  # m, around a robot or object, where floor may stay unknown
_SAMPLES = 16  # of a line of sight
_GIVEN_UP = 0.5  # m, around a frontier
_IDLE_TIME = 2.95  # s without anything to do for all robots, after which a mission ends
_FACING = 20.0  # degrees, largest bearing of a look
_AT_GOAL = 0.1  # m
_TURNED = np.radians(10.0)  # rad, from the heading at a frontier
_PROGRESS = 0.05  # m, minimum shortening of the path that counts as progress


@checks.typed
def rollout_batch(
    keys: Key,
    mission: Mission,
    models: Models,
    policy: Values,
    states: ExplorationState,
    steps: int,
) -> ExplorationState:
    """Runs B missions side by side for some control periods.

    Args:
      keys: `[B]` random keys.
      policy: of all robots; static, as are `steps`.
    """

    def go_on(states: ExplorationState, keys: Key):
        return step(keys, mission, models, policy, states), None

    step_keys = jax.vmap(lambda key: jax.random.split(key, steps), out_axes=1)(keys)
    return jax.lax.scan(go_on, states, step_keys)[0]


def step(
    keys: Key, mission: Mission, models: Models, policy: Values, states: ExplorationState
) -> ExplorationState:
    """Runs one control period of B missions side by side: all robots sense, decide and move."""
    before, num_robots = states, mission.world.arena.num_robots
    split = jax.vmap(lambda key: jax.random.split(key, 3), out_axes=1)
    sense_keys, choice_keys, drift_keys = split(keys)

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
        states = jax.vmap(functools.partial(_progressed, mission), (0, None))(states, robot)
    states, _ = jax.lax.scan(decided, states, all_robots)
    steer_each = jax.vmap(functools.partial(steer, mission), (None, 0))
    wanted = jax.vmap(steer_each, (0, None))(states, all_robots)
    states = drifted(drift_keys, mission, before, move(mission, states, wanted))
    is_idle = states.robots.target == before.slots.is_used.shape[1] + NUM_FRONTIERS
    since = states.time[:, None] - states.robots.progress_at
    is_over = jnp.all(is_idle & (since > _IDLE_TIME), axis=-1)
    steps = states.steps + 1
    is_late = steps * CONTROL_PERIOD >= mission.config.mission.time_limit
    after = dataclasses.replace(states, steps=steps, done=is_over | is_late)
    keep = jax.vmap(jnp.where)
    return jax.tree.map(lambda x, y: keep(before.done, x, y), before, after)


def steer(mission: Mission, state: ExplorationState, robot: Index) -> Float[Array, "2"]:
    """Speeds that a robot wants: along its way, or turning to the object that it looks at.

    Its proximity sensors show what is near.
    """
    poses, robots, pose = state.scene.poses, state.robots, state.believed_poses[robot]
    goal, backs_off = robots.goal[robot], state.time < robots.backs_off_until[robot]
    waypoint = grids.way(state.grid, robots.way[robot], pose[:2])
    drive = navigation.drive_to(
        mission.config.arena,
        state.scene.layout,
        poses,
        robots.command,
        robot,
        localisation.aimed_at(waypoint, poses[robot], state.pose_error[robot]),
        CONTROL_PERIOD,
        backs_off,
    )
    turn = navigation.face(within_a_turn(goal[2] - pose[2]))
    return jnp.where(_is_there(state, robot) & ~backs_off, turn, drive)


def _is_there(state: ExplorationState, robot: Index) -> Bool[Array, ""]:
    """Whether a robot has arrived at its goal."""
    way = state.robots.goal[robot, :2] - state.believed_poses[robot, :2]
    return jnp.linalg.norm(way) < _AT_GOAL


def _progressed(mission: Mission, state: ExplorationState, robot: Index) -> ExplorationState:
    """Notes whether a robot gets nearer to its goal; one that does not backs off, and reconsiders.

    It reconsiders, too, once it has turned to a frontier, or if its slot has been cleared. A
    viewpoint that it has not reached is one of a failed look. Floor at a frontier that it has still
    not seen, or not reached, is given up.
    """
    robots, pose = state.robots, state.believed_poses[robot]
    left = decide.lengths_at(state.grid, robots.way[robot], pose[None, :2])[0]
    off = jnp.abs(within_a_turn(robots.goal[robot, 2] - pose[2]))
    there = _is_there(state, robot)
    progresses = left < robots.left[robot] - _PROGRESS
    is_stuck = ~there & ~progresses & (state.time - robots.progress_at[robot] > STUCK_TIME)
    target, number = robots.target[robot], len(state.slots.is_used)
    explores = (target >= number) & (target < number + NUM_FRONTIERS)
    ends = explores & there & (off < _TURNED)
    is_gone = (target < number) & ~state.slots.is_used[jnp.minimum(target, number - 1)]
    until = jnp.where(is_stuck, state.time + RECOVERY_TIME, robots.backs_off_until[robot])
    modality, floor = mission.modalities[robot], state.grid
    is_given_up = floor.offsets(robots.goal[robot, :2])[2] < _GIVEN_UP
    given_up = floor.given_up[modality] | (is_given_up & explores & (ends | is_stuck))
    floor = dataclasses.replace(floor, given_up=floor.given_up.at[modality].set(given_up))
    works = target < number + NUM_FRONTIERS
    notes = progresses | (there & works) | is_stuck
    state = dataclasses.replace(state, grid=floor)
    gives_up, place = is_stuck & (target < number), robots.goal[robot, :2]
    state = _with_failure(state, state.slots, robot, modality, gives_up, place)
    return state.with_robot(
        robot,
        left=jnp.where(is_stuck, jnp.inf, jnp.where(progresses, left, robots.left[robot])),
        progress_at=jnp.where(notes, state.time, robots.progress_at[robot]),
        backs_off_until=until,
        reconsiders=robots.reconsiders[robot] | is_stuck | ends | is_gone,
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
    pose, arena = state.believed_poses[robot], mission.world.arena
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
    beside = others(state.believed_poses[:, :2], robot)
    spread = _spread(mission, state)
    far = jnp.linalg.norm(beside - pose[None, :2], axis=-1)
    radii = 2 * amiro.BODY_RADIUS + 2 * jnp.sqrt(spread(far))[:, None]
    candidates = proposals.propose(
        sensor,
        readings,
        pose,
        outer_walls(config.arena.side),
        jnp.concatenate([beside, radii], axis=1),
        config.arena.poi_radius,
        _NUM_CANDIDATES,
        config.arena.poi_half_width,
    )
    is_there = jax.vmap(
        lambda bearing, distance: models.detect(modality, sensor, readings, bearing, distance)
    )(candidates.bearing, candidates.distance).is_there
    in_range = candidates.distance <= config.viewpoint.max_distance
    in_range &= candidates.distance >= config.viewpoint.min_distance
    in_range &= jnp.abs(candidates.bearing) <= jnp.radians(_FACING)
    reach, radius = config.arena.side / 2, config.arena.poi_radius
    margin = 2 * jnp.sqrt(spread(candidates.distance)) - radius
    is_inside = jnp.max(jnp.abs(candidates.position), axis=-1) < reach + margin
    is_valid = candidates.is_valid & is_inside & (is_there | ~in_range)
    doubt = spread(candidates.distance)[:, None, None] * jnp.eye(2)[None]
    covariance = candidates.covariance + doubt
    candidates = dataclasses.replace(candidates, is_valid=is_valid, covariance=covariance)
    found = objects.associate(state.slots, candidates, radius)
    slots = objects.with_candidates(state.slots, candidates, found, _DETECTION, _CLUTTER)
    floor, farthest = state.grid, proposals.reach(sensor, config.arena.poi_half_width)
    if sensor.measures_distance:
        most = proposals.max_range(sensor)
        ignored = jnp.concatenate(
            [jnp.where(slots.is_used[:, None], slots.position, jnp.inf), beside]
        )
        floor = grids.with_scan(
            floor, pose, sensor.angles, readings, most, ignored, modality, farthest
        )
    else:
        view = jnp.radians(sensor.field_of_view)
        floor = grids.with_view(floor, pose, view, farthest, modality)
    state = dataclasses.replace(state, slots=slots, grid=floor)
    if sensor.measures_distance or sensor.channels == proposals.RGB:
        looked_at = _looks(state, robot) & (jnp.arange(len(slots.is_used)) == _target(state, robot))
        missed = _expected(mission, state, sensor, readings, robot) & ~found.is_seen & ~looked_at
        # What is beside another robot may have been taken for it.
        apart = jnp.linalg.norm(slots.position[:, None] - beside[None], axis=-1)
        missed &= jnp.all(apart > radii.T + radius, axis=1)
        slots = objects.with_misses(models, slots, missed, _DETECTION)
        state = dataclasses.replace(state, slots=objects.merged(models, slots, radius))
    return _look(mission, models, state, readings, candidates, found, robot, modality)


def _spread(mission: Mission, state: ExplorationState) -> Callable[[jax.Array], jax.Array]:
    """Variance of places by their distance, as far as robots know how much they may err."""
    driven = state.time * amiro.MAX_SPEED
    return functools.partial(localisation.variance, mission.config.mission.localisation, driven)


def outer_walls(side: float) -> Float[Array, "4 4"]:
    """The walls that robots know: from x and y to x and y, in metres."""
    corners = side / 2 * jnp.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])
    return jnp.concatenate([corners, jnp.roll(corners, -1, axis=0)], axis=1)


def _in_sight(mission: Mission, state: ExplorationState, robot: int) -> Bool[Array, " S"]:
    """Slots whose objects nothing hides from a robot: over known floor, behind no nearer body."""
    pose, positions, arena = state.believed_poses[robot], state.slots.position, mission.config.arena
    bodies = jnp.where(state.slots.is_used[:, None], positions, jnp.inf)
    bodies = jnp.concatenate([bodies, others(state.believed_poses[:, :2], robot)])
    number = len(positions)
    radius = jnp.where(jnp.arange(len(bodies)) < number, arena.poi_extent, amiro.BODY_RADIUS)
    way = bodies - pose[None, :2]
    distance = jnp.maximum(jnp.linalg.norm(way, axis=-1), 1e-3)
    bearing, half_width = jnp.arctan2(way[:, 1], way[:, 0]), radius / distance
    apart = jnp.abs(within_a_turn(bearing[:number, None] - bearing[None]))
    is_beside = apart < half_width[:number, None] + half_width[None]
    covers = is_beside & (distance[None] < distance[:number, None])

    def is_open(distance: jax.Array, way: jax.Array) -> jax.Array:
        depths = jnp.linspace(_NEAR, jnp.maximum(distance - _NEAR, _NEAR), _SAMPLES)
        line = pose[None, :2] + (depths / distance)[:, None] * way[None]
        return jnp.all(state.grid.at(state.grid.free, line))

    is_open_to = jax.vmap(is_open)(distance[:number], way[:number])
    return state.slots.is_used & is_open_to & ~jnp.any(covers, axis=1)


def _expected(
    mission: Mission,
    state: ExplorationState,
    sensor: scanners.Sensor,
    readings: Float[Array, "B *channels"],
    robot: int,
) -> Bool[Array, " S"]:
    """Slots that a scan shows if they hold an object: in view, in range and not hidden.

    If it measures distances, beams must pass through the place: an object that stands before
    another one, or a wall, may be no candidate.
    """
    radius = mission.config.arena.poi_radius
    pose, positions = state.believed_poses[robot], state.slots.position
    bearing = jax.vmap(viewpoints.bearing, (None, 0))(pose, positions)
    distance = jnp.linalg.norm(positions - pose[None, :2], axis=-1)
    in_view = jnp.abs(bearing) < jnp.radians(sensor.field_of_view / 2 - _RIM)
    in_view &= distance > mission.config.viewpoint.min_distance
    in_view &= distance < proposals.reach(sensor, mission.config.arena.poi_half_width)
    if sensor.measures_distance:
        half = jnp.arcsin(jnp.minimum(radius / 2 / jnp.maximum(distance, radius), 1.0))
        aside = bearing[None] + jnp.array([-1.0, 0.0, 1.0])[:, None] * half[None]
        beams = (aside - sensor.angles[0]) / (sensor.angles[1] - sensor.angles[0])
        beams = jnp.where(beams < -0.5, len(readings), jnp.round(beams)).astype(jnp.int32)
        ends = readings.at[beams].get(mode="fill", fill_value=0.0)
        in_view &= jnp.all(ends > distance[None] + radius, axis=0)
    return in_view & _in_sight(mission, state, robot)


def _target(state: ExplorationState, robot: Index) -> Int[Array, ""]:
    """The slot that a robot heads for; the last one if it heads for none."""
    return jnp.minimum(state.robots.target[robot], len(state.slots.is_used) - 1)


def _looks(state: ExplorationState, robot: int) -> Bool[Array, ""]:
    """Whether a robot has arrived at its viewpoint, and turned to its target."""
    target, pose = _target(state, robot), state.believed_poses[robot]
    bearing = viewpoints.bearing(pose, state.slots.position[target])
    is_slot = (state.robots.target[robot] < len(state.slots.is_used)) & state.slots.is_used[target]
    return is_slot & _is_there(state, robot) & (jnp.abs(bearing) < jnp.radians(_FACING))


def _look(
    mission: Mission,
    models: Models,
    state: ExplorationState,
    readings: Float[Array, "B *channels"],
    candidates: Candidates,
    found: Association,
    robot: int,
    modality: int,
) -> ExplorationState:
    """Updates the belief of the robot's target, if it looks at it, with what its scan says.

    It looks where the scan shows the target, which a wrong pose does not change.
    """
    slots, target, looks = state.slots, _target(state, robot), _looks(state, robot)
    pose, centre = state.believed_poses[robot], slots.position[target]
    bearing, distance = viewpoints.bearing(pose, centre), jnp.linalg.norm(centre - pose[:2])
    sensor, candidate = mission.world.sensors[modality], found.candidate[target]
    is_shown = candidate < len(candidates.is_valid)
    bearing = jnp.where(is_shown, candidates.bearing.at[candidate].get(mode="clip"), bearing)
    if sensor.measures_distance:
        shown = candidates.distance.at[candidate].get(mode="clip")
        distance = jnp.where(is_shown, shown, distance)
    detection = models.detect(modality, sensor, readings, bearing, distance)
    sees = looks & decide.can_look(mission, state, pose[:2], centre)
    sees &= _in_sight(mission, state, robot)[target]
    is_confident = jnp.max(detection.features) >= mission.config.mission.least_confidence
    detects = sees & detection.is_there & is_confident
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
    place = jnp.where(detects, pose[:2], slots.looked_from[target, modality, at])
    after = dataclasses.replace(
        slots,
        belief=belief,
        log_posterior=log_posterior,
        times_seen=slots.times_seen.at[target, modality].add(detects),
        looked_from=slots.looked_from.at[target, modality, at].set(place),
    )
    is_target = jnp.arange(len(slots.is_used)) == target
    # A robot that may err has perhaps looked beside it.
    shows = sees & (is_shown | (_spread(mission, state)(distance) == 0))
    after = objects.with_misses(models, after, is_target & shows & ~detection.is_there, _SHOWN)
    fails = looks & ~detects
    return _with_failure(state, after, robot, modality, fails, pose[:2]).with_robot(
        robot,
        looks=state.robots.looks[robot] + looks,
        reconsiders=state.robots.reconsiders[robot] | looks,
    )


def _with_failure(
    state: ExplorationState,
    slots: Slots,
    robot: Index,
    modality: Index,
    fails: Bool[Array, ""],
    position: Float[Array, "2"],
) -> ExplorationState:
    """Notes from where a look at the robot's target failed; cleared slots have no failures."""
    target = _target(state, robot)
    number, places = state.failures[target, modality], state.failed_from
    at = number % places.shape[2]
    place = jnp.where(fails, position, places[target, modality, at])
    places = places.at[target, modality, at].set(place)
    failures = state.failures.at[target, modality].set(number + fails)
    return dataclasses.replace(
        state,
        slots=slots,
        failures=jnp.where(slots.is_used[:, None], failures, 0),
        failed_from=jnp.where(slots.is_used[:, None, None, None], places, jnp.inf),
    )
