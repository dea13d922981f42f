"""What a robot can do next, and the policies that choose: looks, frontiers, or nothing more."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxsense.config.learning import LOOK_SECONDS
from jaxsense.config.mission import PLANNING_RADIUS
from jaxsense.core.types import Index, Key, others, pytree
from jaxsense.dqn.policies import best
from jaxsense.exploration import grid as grids
from jaxsense.exploration import proposals
from jaxsense.exploration import slots as objects
from jaxsense.exploration.grid import Grid
from jaxsense.exploration.state import NUM_FRONTIERS, ExplorationState
from jaxsense.mission.state import ATTEMPTS, Mission
from jaxsense.models import Models
from jaxsense.sim import amiro

_VIEW_SIDES = 16  # directions from which a robot may look at a slot
_VIEW_SHARES = (0.6, 0.9)  # of the longest distance of a look
_TURN_SECONDS = 1.0  # before a look
_BESIDE = 1.0  # m, between two robots' goals at one frontier
_STANDS = 0.02  # m/s, below which a robot does not drive
_SAME_GOAL = 0.2  # m, between goals, or places of a look, that count as one
_SAMPLES = 16  # of a line of sight
_TAKEN = 60.0  # s, detour that a robot prefers to what another one heads for


@pytree
class Options:
    """What a robot can do: look at one of S slots, or drive to one of F frontiers, `[S + F]` each.

    Attributes:
      gain: of a look in nats; of a frontier, its unseen floor in m2, times what the robot's sensor
        sees at once as a share of the most that one of the team sees.
      seconds: until it is done.
      goal: x [m], y [m] and yaw [rad] in which to end.
      is_possible: whether there is such an option, and a path to it.
      is_taken: whether another robot heads for it.
      is_look: whether it is a look.
    """

    gain: Float[Array, " A"]
    seconds: Float[Array, " A"]
    goal: Float[Array, "A 3"]
    is_possible: Bool[Array, " A"]
    is_taken: Bool[Array, " A"]
    is_look: Bool[Array, " A"]


Policy = Callable[[Key, Models, Options], jax.Array]
"""`(key, models, options) -> [S + F + 1]` values, the last of doing nothing more."""


def explore_first(key: Key, models: Models, options: Options) -> Float[Array, " A+1"]:
    """Drives to the nearest frontier until none is left, and looks then."""
    del key, models
    return _ranked(options, 1 / (1 + _cost(options)) + ~options.is_look)


def look_first(key: Key, models: Models, options: Options) -> Float[Array, " A+1"]:
    """Takes the nearest look that pays, and explores when there is none."""
    del key, models
    return _ranked(options, 1 / (1 + _cost(options)) + options.is_look)


def nearest(key: Key, models: Models, options: Options) -> Float[Array, " A+1"]:
    """Takes the nearest of looks and frontiers."""
    del key, models
    return _ranked(options, 1 / (1 + _cost(options)))


def gain_rate(key: Key, models: Models, options: Options) -> Float[Array, " A+1"]:
    """Takes the most a second; a look that pays counts as 1 m2 of unseen floor, 4 m2 as two."""
    del key, models
    return _ranked(
        options, jnp.where(options.is_look, 1.0, jnp.sqrt(options.gain)) / _cost(options)
    )


POLICIES: dict[str, Policy] = {
    "explore_first": explore_first,
    "look_first": look_first,
    "nearest": nearest,
    "gain_rate": gain_rate,
}
"""Hand-written policies by name."""


def _cost(options: Options) -> jax.Array:
    return options.seconds + jnp.where(options.is_taken, _TAKEN, 0.0)


def _ranked(options: Options, values: jax.Array) -> jax.Array:
    """Values of what is possible and pays; doing nothing more is worth 0."""
    return jnp.append(jnp.where(options.is_possible & (options.gain > 0), values, -1.0), 0.0)


def choose(
    key: Key,
    mission: Mission,
    models: Models,
    policy: Policy,
    state: ExplorationState,
    robot: Index,
) -> ExplorationState:
    """Lets a robot choose, and plans its way."""
    options = options_of(mission, models, state, robot)
    target = best(policy(key, models, options))
    nothing = len(options.gain)
    goal = options.goal[jnp.minimum(target, nothing - 1)]
    goal = jnp.where(target == nothing, state.scene.poses[robot], goal)
    way = grids.distances(state.grid, goal[:2], blocked(mission, state, robot))
    length = lengths_at(state.grid, way, state.scene.poses[robot, None, :2])[0]
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


def options_of(mission: Mission, models: Models, state: ExplorationState, robot: Index) -> Options:
    """What a robot can do."""
    pose, modality = state.scene.poses[robot], mission.modalities[robot]
    lengths = grids.distances(state.grid, pose[:2], blocked(mission, state, robot))
    frontiers = grids.frontiers(state.grid, modality, lengths, NUM_FRONTIERS)
    views, to_view = _views(mission, models, state, robot, lengths)
    slots, robots = state.slots, state.robots
    number = len(slots.existence)
    probabilities = jax.vmap(models.fusion.class_probabilities)(slots.belief)
    is_seen = jnp.any(slots.times_seen > 0, axis=-1)
    values = jnp.stack(
        [jax.vmap(x.of_next, (0, 0))(probabilities, is_seen) for x in models.look_values]
    )[modality]
    to_slot = slots.position - views
    yaw = jnp.append(jnp.arctan2(to_slot[:, 1], to_slot[:, 0]), frontiers.heading)
    place = jnp.concatenate([views, frontiers.position])
    is_open = (state.failures[:, modality] < ATTEMPTS) & objects.found(slots)
    goal = jnp.append(place, yaw[:, None], axis=1)
    is_look = jnp.arange(len(goal)) < number
    target, headed = others(robots.target, robot), others(robots.goal, robot)
    beside = jnp.linalg.norm(place[:, None] - headed[None, :, :2], axis=-1) < _BESIDE
    is_same = jnp.arange(len(goal))[:, None] == target[None]
    explores = (target >= number) & (target < len(goal))
    same_sensor = others(mission.modalities, robot) == modality
    is_taken = jnp.where(is_look[:, None], is_same & same_sensor[None], beside & explores[None])
    length = jnp.append(to_view, frontiers.distance)
    return Options(
        gain=jnp.append(
            jnp.where(is_open, values, 0.0), frontiers.size * _shares(mission)[modality]
        ),
        seconds=length / amiro.MAX_SPEED
        + jnp.where(is_look, LOOK_SECONDS + _TURN_SECONDS, _TURN_SECONDS),
        goal=goal,
        is_possible=jnp.append(slots.is_used, frontiers.is_valid) & jnp.isfinite(length),
        is_taken=jnp.any(is_taken, axis=-1),
        is_look=is_look,
    )


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
    places = others(state.scene.poses[:, :2], robot)
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
    slots, position = state.slots, state.scene.poses[robot, :2]
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
