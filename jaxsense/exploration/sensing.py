"""What scans of robots tell: floor, objects, and what they look at."""

import dataclasses
import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float
from mujoco import mjx

from jaxsense.config.mission import CONTROL_PERIOD
from jaxsense.core.types import Key, others, within_a_turn
from jaxsense.exploration import decide, proposals
from jaxsense.exploration import grid as grids
from jaxsense.exploration import slots as objects
from jaxsense.exploration.proposals import Candidates
from jaxsense.exploration.slots import Association
from jaxsense.exploration.state import ExplorationState
from jaxsense.mission.state import RECENT_LOOKS, Mission
from jaxsense.models import Models
from jaxsense.sim import amiro, localisation, viewpoints
from jaxsense.sim import arena as arenas
from jaxsense.sim import sensors as scanners

_NUM_CANDIDATES = 8
_DETECTION, _CLUTTER = 0.9, 0.01  # of an object in view; false ones per scan and square metre
_SHOWN = 0.98  # probability that a look at an object shows it
_RIM = 10.0  # degrees, at the rim of a scan, where it may cut a PoI
_NEAR = 0.3  # m, around a robot or object, where floor may stay unknown
_SAMPLES = 16  # of a line of sight
_FACING = 20.0  # degrees, largest bearing of a look


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
        looked_at = _looks(state, robot) & (
            jnp.arange(len(slots.is_used)) == state.target_slot(robot)
        )
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


def _looks(state: ExplorationState, robot: int) -> Bool[Array, ""]:
    """Whether a robot has arrived at its viewpoint, and turned to its target."""
    target, pose = state.target_slot(robot), state.believed_poses[robot]
    bearing = viewpoints.bearing(pose, state.slots.position[target])
    is_slot = (state.robots.target[robot] < len(state.slots.is_used)) & state.slots.is_used[target]
    return is_slot & state.is_at_goal(robot) & (jnp.abs(bearing) < jnp.radians(_FACING))


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
    slots, target, looks = state.slots, state.target_slot(robot), _looks(state, robot)
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
    state = dataclasses.replace(state, slots=after)
    return state.with_failure(robot, modality, fails, pose[:2]).with_robot(
        robot,
        looks=state.robots.looks[robot] + looks,
        reconsiders=state.robots.reconsiders[robot] | looks,
    )
