"""What a robot can do next, and the policies that choose: looks, frontiers, or nothing more."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxsense.config.mission import PLANNING_RADIUS
from jaxsense.core.types import Index, Key, others, within_a_turn
from jaxsense.dqn import policies
from jaxsense.dqn.policies import Trained, Values
from jaxsense.dqn.team import Known, Team
from jaxsense.exploration import grid as grids
from jaxsense.exploration import proposals
from jaxsense.exploration import slots as objects
from jaxsense.exploration.grid import Frontiers, Grid
from jaxsense.exploration.state import AT_GOAL, NUM_FRONTIERS, ExplorationState
from jaxsense.mission.decide import action_of
from jaxsense.mission.state import ATTEMPTS, Mission
from jaxsense.models import Models, make_travel

_VIEW_SIDES = 16  # directions from which a robot may look at a slot
_VIEW_SHARES = (0.6, 0.9)  # of the longest distance of a look
_BESIDE = 1.0  # m, between two robots' goals at one frontier
_STANDS = 0.02  # m/s, below which a robot does not drive
_SAME_GOAL = 0.2  # m, between goals, or places of a look, that count as one
_SAMPLES = 16  # of a line of sight
_IGNORED = 0.03  # of the floor, which stays unseen with .01 of the PoIs; to see it takes 15 s
_FRONTIER = 6.0  # of a frontier where a PoI is certain, in looks
_TAKEN = 60.0  # s, detour that a robot prefers to what another one heads for


_nearest = policies.POLICIES["nearest"]


def explore_first(key: Key, models: Trained, known: Known) -> Float[Array, " A"]:
    """Drives to the nearest frontier until none is left, and looks then."""
    return _first(_is_frontier(known), key, models, known)


def look_first(key: Key, models: Trained, known: Known) -> Float[Array, " A"]:
    """Takes the nearest look that pays, and explores when there is none."""
    return _first(~_is_frontier(known), key, models, known)


def gain_rate(key: Key, models: Trained, known: Known) -> Float[Array, " A"]:
    """Takes the most a second: a look counts 1, a frontier 6 roots of the chance of a PoI there."""
    team, is_frontier = known.team, _is_frontier(known)
    gains = jnp.where(is_frontier, _FRONTIER * jnp.sqrt(known.exists), 1.0)
    competes = (team.modality == known.modality)[:, None] | is_frontier[None]
    is_taken = jnp.any(team.heads & team.others(known.robot)[:, None] & competes, axis=0)
    rates = gains / (1 + known.times[known.robot] + _TAKEN * is_taken)
    values = _nearest(key, models, known)
    return jnp.where(values > 0, jnp.append(rates, 0.0), values)


POLICIES: dict[str, Values] = {
    **{name: policies.POLICIES[name] for name in ("latent", "auction", "nearest")},
    "gain_rate": gain_rate,
    "look_first": look_first,
    "explore_first": explore_first,
}
"""Policies by name; to those of missions, a frontier is a PoI that may be there."""


def _is_frontier(known: Known) -> Bool[Array, " N"]:
    return jnp.asarray(known.exists) < 1


def _first(comes_first: jax.Array, key: Key, models: Trained, known: Known) -> jax.Array:
    """The nearest of those that come first, if they pay, or else of all."""
    values = _nearest(key, models, known)
    return jnp.where((values > 0) & jnp.append(comes_first, False), values + 1, values)


def choose(
    key: Key,
    mission: Mission,
    models: Models,
    policy: Values,
    state: ExplorationState,
    robot: Index,
) -> ExplorationState:
    """Lets a robot choose, and plans its way."""
    known, goals = options_of(mission, models, state, robot)
    target, nothing = action_of(policy(key, models, known), known), len(goals)
    target = jnp.where(target < 0, nothing, target)  # NaN
    goal = goals[jnp.minimum(target, nothing - 1)]
    goal = jnp.where(target == nothing, state.believed_poses[robot], goal)
    way = grids.distances(state.grid, goal[:2], blocked(mission, state, robot))
    length = lengths_at(state.grid, way, state.believed_poses[robot, None, :2])[0]
    left = jnp.where(jnp.isfinite(length), length, 0.0)
    is_same = jnp.linalg.norm(goal[:2] - state.robots.goal[robot, :2]) < _SAME_GOAL
    return state.with_robot(
        robot,
        target=target,
        goal=goal,
        way=way,
        reconsiders=jnp.bool_(False),
        left=jnp.where(is_same, jnp.maximum(state.robots.left[robot], left), jnp.inf),
        progress_at=jnp.where(is_same, state.robots.progress_at[robot], state.time),
    )


def options_of(
    mission: Mission, models: Models, state: ExplorationState, robot: Index
) -> tuple[Known, Float[Array, "N 3"]]:
    """What a robot can do: look at one of S slots, or drive to one of F frontiers; N in all.

    Returns:
      What the robot knows of them, for policies: a frontier is a PoI that may be there, at which
      nobody has looked. And their goals: x [m], y [m] and yaw [rad].
    """
    pose, modality = state.believed_poses[robot], mission.modalities[robot]
    lengths = grids.distances(state.grid, pose[:2], blocked(mission, state, robot))
    arena, slots, number = mission.config.arena, state.slots, len(state.slots.existence)
    room, ignored = grids.room(state.grid, arena.poi_gap), _IGNORED * arena.side**2
    frontiers = grids.frontiers(state.grid, modality, lengths, NUM_FRONTIERS, room, ignored)
    views, to_view = _views(mission, models, state, robot, lengths)
    to_slot = slots.position - views
    yaw = jnp.append(jnp.arctan2(to_slot[:, 1], to_slot[:, 0]), frontiers.heading)
    goals = jnp.append(jnp.concatenate([views, frontiers.position]), yaw[:, None], axis=1)
    length = jnp.append(to_view, frontiers.distance)
    is_open = slots.is_used & objects.found(slots) & (state.failures[:, modality] < ATTEMPTS)
    expected = arena.density * _shares(mission)[modality] * frontiers.size
    exists = jnp.append(jnp.ones(number), -jnp.expm1(-expected))
    target = _headed_for(state, frontiers)
    team = Team(
        positions=jnp.concatenate([slots.position, frontiers.position]),
        present=jnp.append(is_open, frontiers.is_valid) & jnp.isfinite(length) & (exists > 0),
        poses=state.believed_poses,
        modality=mission.modalities,
        works=(state.robots.target < len(goals)) | (jnp.arange(len(target)) == robot),
        target=target,
    )
    nobody = dataclasses.replace(objects.empty(models, NUM_FRONTIERS), overflow=())
    points = dataclasses.replace(slots, overflow=())
    points = jax.tree.map(lambda *x: jnp.concatenate(x), points, nobody)
    known = Known(
        belief=points.belief,
        looks=points.times_seen,
        log_posterior=points.log_posterior,
        team=team,
        times=_times(mission, team, robot, length, yaw, number),
        robot=jnp.asarray(robot),
        exists=exists,
    )
    return known, goals


def _headed_for(state: ExplorationState, frontiers: Frontiers) -> Int[Array, " R"]:
    """The place that each robot heads for; of frontiers, the one next to its goal."""
    target, number = state.robots.target, len(state.slots.existence)
    nothing = number + NUM_FRONTIERS
    to_goal = frontiers.position[None] - state.robots.goal[:, None, :2]
    apart = jnp.where(frontiers.is_valid[None], jnp.linalg.norm(to_goal, axis=-1), jnp.inf)
    is_beside = jnp.min(apart, axis=1) < _BESIDE
    beside = jnp.where(is_beside, number + jnp.argmin(apart, axis=1), nothing)
    return jnp.where((target >= number) & (target < nothing), beside, target)


def _times(
    mission: Mission,
    team: Team,
    robot: Index,
    length: Float[Array, " N"],
    yaw: Float[Array, " N"],
    number: int,
) -> Float[Array, "R N"]:
    """Seconds until robots have looked at the first places, and have reached the others.

    The robot's own by the lengths of its paths, in metres, those of others as if nothing stood
    between.
    """
    pose, to_go = team.poses[robot], jnp.zeros(team.heads.shape)
    x, y = (team.positions - pose[None, :2]).T
    turn = within_a_turn(jnp.where(length > AT_GOAL, jnp.arctan2(y, x), yaw) - pose[2])
    look = make_travel(mission.config)
    drive = dataclasses.replace(look, view_distance=0.0, look_seconds=0.0)
    times = [x.times(team, to_go).at[robot].set(x.duration(turn, length)) for x in (look, drive)]
    return jnp.where((jnp.arange(len(length)) < number)[None], *times)


def _shares(mission: Mission) -> Float[Array, " M"]:
    """Floor in view of each modality, as a share of the most that a robot of the team has."""
    narrowest = mission.config.arena.poi_half_width
    sensors = mission.world.sensors
    floor = jnp.stack([x.field_of_view * proposals.reach(x, narrowest) ** 2 for x in sensors])
    return floor / jnp.max(floor[mission.modalities])


def blocked(mission: Mission, state: ExplorationState, robot: Index) -> Float[Array, "P 3"]:
    """Circles that no path may cross: x, y and radius of slots and of robots that stand."""
    arena, slots = mission.config.arena, state.slots
    speeds = others(state.robots.command, robot)[:, 0]
    places = others(state.believed_poses[:, :2], robot)
    places = jnp.where((jnp.abs(speeds) < _STANDS)[:, None], places, jnp.inf)
    objects = jnp.where(slots.is_used[:, None], slots.position, jnp.inf)
    radii = jnp.append(
        jnp.full(len(objects), arena.poi_extent), jnp.full(len(places), PLANNING_RADIUS)
    )
    return jnp.concatenate([jnp.concatenate([objects, places]), radii[:, None]], axis=1)


def _views(
    mission: Mission,
    models: Models,
    state: ExplorationState,
    robot: Index,
    lengths: Float[Array, "K K"],
) -> tuple[Float[Array, "S 2"], Float[Array, " S"]]:
    """Nearest place to look at each slot from where a look is new, and metres to it."""
    config, modality = mission.config, mission.modalities[robot]
    slots, position = state.slots, state.believed_poses[robot, :2]
    sides = 2 * jnp.pi * jnp.arange(float(_VIEW_SIDES)) / _VIEW_SIDES
    ring = jnp.stack([jnp.cos(sides), jnp.sin(sides)], axis=-1)
    near = config.viewpoint.min_distance + PLANNING_RADIUS
    distances = jnp.maximum(config.navigation.view_range * jnp.array(_VIEW_SHARES), near)
    offsets = (distances[:, None, None] * ring[None]).reshape(-1, 2)

    def of_slot(
        centre: jax.Array, looked_from: jax.Array, failed_from: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        places = jnp.concatenate([centre[None] + offsets, position[None]])
        apart = jnp.linalg.norm(places[:, None] - looked_from[None], axis=-1)
        is_new = models.novelty.to_go(apart, modality) <= 0
        from_failed = jnp.linalg.norm(places[:, None] - failed_from[None], axis=-1)
        is_new &= jnp.min(from_failed, axis=1) > _SAME_GOAL
        sees = jax.vmap(lambda place: can_look(mission, state, place, centre))(places)
        length = jnp.append(lengths_at(state.grid, lengths, places[:-1]), 0.0)
        length = jnp.where(is_new & sees, length, jnp.inf)
        nearest = jnp.argmin(length)
        return places[nearest], length[nearest]

    looked_from, failed_from = slots.looked_from[:, modality], state.failed_from[:, modality]
    return jax.vmap(of_slot)(slots.position, looked_from, failed_from)


def can_look(
    mission: Mission, state: ExplorationState, place: Float[Array, "2"], centre: Float[Array, "2"]
) -> Bool[Array, ""]:
    """Whether a place is in range of an object, with a free line of sight as far as known."""
    config = mission.config
    distance = jnp.linalg.norm(centre - place)
    in_range = distance >= config.viewpoint.min_distance
    in_range &= distance <= config.navigation.view_range
    beside = 1 - config.arena.poi_extent / jnp.maximum(distance, 1e-3)
    return in_range & is_clear(state.grid, place, place + beside * (centre - place))


def is_clear(grid: Grid, start: Float[Array, "2"], end: Float[Array, "2"]) -> Bool[Array, ""]:
    """Whether a straight line crosses no cell that is known to be occupied."""
    shares = np.linspace(0.0, 1.0, _SAMPLES, dtype=np.float32)[:, None]
    return ~jnp.any(grid.at(grid.occupied, start[None] + shares * (end - start)[None]))


def lengths_at(
    grid: Grid, lengths: Float[Array, "K K"], places: Float[Array, "V 2"]
) -> Float[Array, " V"]:
    """Lengths of paths to places; infinite outside of the arena."""
    return jnp.take(lengths.ravel(), grid.index(places), mode="fill", fill_value=jnp.inf)
