"""Choosing the PoI that a robot looks at next, and the viewpoint."""

import dataclasses

import jax
import jax.numpy as jnp

from jaxsense.core.types import Index, Key, others
from jaxsense.dqn import team_mdp
from jaxsense.dqn.policies import Known
from jaxsense.dqn.team_mdp import Team
from jaxsense.mission import roadmap
from jaxsense.mission.state import (
    BACKING,
    DRIVING,
    ENDED,
    FACING,
    FAILED,
    IDLE,
    Mission,
    MissionState,
    now,
    robot_of,
    with_robot,
)
from jaxsense.models import Models
from jaxsense.sim import viewpoints

_KEPT, _HEADED_FOR = -1e4, 1e2  # m, larger than any distance
_DETOUR = 2.0  # m, detour that a robot prefers to a viewpoint occupied by another


def is_due(mission: Mission, state: MissionState, robot: Index) -> jax.Array:
    """Whether a robot has to decide, `[]` bool: it has nothing to do, or the map has changed."""
    own = robot_of(state, robot)
    is_under_way = (own.phase == DRIVING) | (own.phase == FACING)
    has_news = (state.version != own.decided_on) & mission.config.mission.redecides
    return (own.phase == IDLE) | (is_under_way & has_news)


def decide(
    key: Key, mission: Mission, models: Models, state: MissionState, robot: Index
) -> MissionState:
    """Asks the policy if a decision is due, and sets out for a viewpoint of the PoI."""
    own, config = robot_of(state, robot), mission.config
    is_idle, decides = own.phase == IDLE, is_due(mission, state, robot)
    action = jnp.where(decides, _choose(key, mission, models, state, robot), own.target)
    is_new = action != own.target
    sets_out = decides & (is_idle | is_new) & (action < config.arena.num_pois)

    # Failures belong to one target.
    excluded = jnp.where(is_new, False, own.excluded)
    view, length, excluded = _best_view(mission, state, robot, action, excluded)
    has_way = jnp.isfinite(length)
    sets_out_now, gives_up = sets_out & has_way, sets_out & ~has_way
    poi = jnp.minimum(action, config.arena.num_pois - 1)
    nothing_left = decides & (action == config.arena.num_pois)
    # What was in the way may have gone: before it ends, a robot tries once more to reach PoIs where
    # it was stuck.
    place = state.scene.poses[robot, :2]
    stuck_at = own.unreachable & roadmap.reaches(config, state.scene.layout, state.roadmap, place)
    tries_again = nothing_left & jnp.any(stuck_at) & ~own.tried_again
    ends, given_up = nothing_left & ~tries_again, own.unreachable & ~(stuck_at & tries_again)
    # A look from the current place is no goal; a PoI without a way to it is a missed one.
    num_views = state.roadmap.viewpoints.shape[1]
    is_goal = (sets_out_now & (view < num_views)) | gives_up
    was_needless = decides & is_new & (own.phase == DRIVING) & (own.view < num_views)
    after = dataclasses.replace(
        own,
        phase=jnp.select(
            [ends, sets_out_now, gives_up | tries_again], [ENDED, DRIVING, IDLE], own.phase
        ),
        target=action,
        view=jnp.where(sets_out_now, view, own.view),
        decided_on=jnp.where(decides, state.version, own.decided_on),
        excluded=excluded,
        attempts=jnp.where(is_new, 0, own.attempts),
        unreachable=jnp.where(gives_up, given_up.at[poi].set(True), given_up),
        tried_again=own.tried_again | tries_again,
        way_left=jnp.where(sets_out_now, length, own.way_left),
        progress_at=jnp.where(sets_out_now, now(mission, state), own.progress_at),
        goals=own.goals + is_goal - was_needless,
    )
    return with_robot(state, robot, own, after)


def _choose(
    key: Key, mission: Mission, models: Models, state: MissionState, robot: Index
) -> jax.Array:
    """PoI that a robot's policy chooses, `[]` int32, or N for NOP."""
    config, robots = mission.config, state.robots
    settings, num_pois = config.mission, config.arena.num_pois
    given_up = robots.unreachable[robot] | robots.undetected[robot]
    known = known_to(mission, state, robot, given_up)
    values = _values(key, mission, models, known, state.policy)
    counts_time = [policy.counts_time(models.agent) for policy in mission.policies.values()]
    # Values that include travel time need no tie-breaking.
    tolerance = jnp.where(jnp.array(counts_time), 0.0, settings.equal_values)[state.policy]
    of_pois = jnp.where(given_up, -jnp.inf, values[:num_pois])
    is_best = (of_pois >= jnp.max(of_pois) - tolerance) & (of_pois > values[num_pois])

    place = state.scene.poses[robot, :2]
    distance = jnp.linalg.norm(state.scene.layout.position - place[None], axis=-1)
    is_kept = jnp.arange(num_pois) == robots.target[robot]
    targets = others(robots.target, robot)
    is_others = jnp.any(jnp.arange(num_pois)[:, None] == targets[None], axis=-1)
    # First the PoI that the robot heads for already, then those no other heads for, then distance.
    rank = jnp.where(settings.nearest_first, distance, jnp.arange(num_pois))
    rank += _KEPT * is_kept + _HEADED_FOR * (is_others & settings.avoids_targets)
    poi = jnp.argmin(jnp.where(is_best, rank, jnp.inf))
    return jnp.where(jnp.any(is_best), poi, num_pois)


def _values(
    key: Key, mission: Mission, models: Models, known: Known, policy: jax.Array
) -> jax.Array:
    """`[N + 1]` values of a policy's actions, NOP's last."""
    of_each = [each.values(key, models, known) for each in mission.policies.values()]
    return jnp.stack(of_each)[policy]


def known_to(mission: Mission, state: MissionState, robot: Index, given_up: jax.Array) -> Known:
    """What a robot knows when it chooses.

    Args:
      mission: the mission.
      state: the current state.
      robot: index of the robot.
      given_up: `[N]` bool, PoIs that the robot has given up.
    """
    phase = state.robots.phase
    team = Team(
        positions=state.scene.layout.position,
        present=~given_up,
        poses=state.scene.poses,
        modality=jnp.array(mission.config.modality_of_robot),
        works=(phase != ENDED) & (phase != FAILED),
        target=state.robots.target,
    )
    return Known(
        belief=state.belief,
        looks=state.times_seen,
        log_posterior=state.log_posterior,
        team=team,
        times=team_mdp.travel_times(mission.config.team.travel, team),
        robot=jnp.asarray(robot),
    )


def _best_view(
    mission: Mission, state: MissionState, robot: Index, target: jax.Array, excluded: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Viewpoint of a PoI with the shortest way, V for the robot's current place.

    Returns:
      The viewpoint, the length of the way, and the `[V + 1]` viewpoints that stay excluded: none if
      all that can be reached have been.
    """
    config, scene = mission.config, state.scene
    poi = jnp.minimum(target, config.arena.num_pois - 1)
    standing = standing_robots(state, robot)
    length = roadmap.lengths(config, scene.layout, state.roadmap, scene.poses[robot, :2], poi)
    places, margin = state.roadmap.viewpoints[poi], config.navigation.margin
    room = viewpoints.free_room(
        places[:, 0], places[:, 1], margin, config.arena, scene.layout, standing, poi
    )
    length += jnp.where(room > 0, 0.0, _DETOUR)
    here = jnp.where(sees(mission, state, robot, poi), 0.0, jnp.inf)
    cost = jnp.append(length, here)
    excluded &= jnp.any(jnp.isfinite(cost) & ~excluded)
    cost = jnp.where(excluded, jnp.inf, cost)
    view = jnp.argmin(cost)
    return view, cost[view], excluded


def sees(mission: Mission, state: MissionState, robot: Index, poi: jax.Array) -> jax.Array:
    """Whether a PoI is in range of a robot and nothing standing covers it, `[]` bool."""
    config, place = mission.config, state.scene.poses[robot, :2]
    layout, standing = state.scene.layout, standing_robots(state, robot)
    distance = jnp.linalg.norm(layout.position[poi] - place)
    in_range = distance >= config.viewpoint.min_distance
    in_range &= distance <= config.navigation.view_range
    room = viewpoints.free_room(place[:1], place[1:], 0.0, config.arena, layout, standing, poi)
    return in_range & (room[0] > 0)


def standing_robots(state: MissionState, robot: Index) -> jax.Array:
    """Places of the other robots, `[R - 1, 2]`; far away for moving ones, which will be gone."""
    phase = others(state.robots.phase, robot)
    drives = (phase == DRIVING) | (phase == BACKING)
    return jnp.where(drives[:, None], 1e3, others(state.scene.poses[:, :2], robot))
