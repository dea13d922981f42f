"""The choice of the PoI that a robot looks at next, and of the viewpoint."""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxsense.config.mission import MARGIN
from jaxsense.core.types import Index, Key, call, pytree
from jaxsense.dqn.policies import Known
from jaxsense.dqn.team import Team
from jaxsense.mission import roadmap
from jaxsense.mission.choice import ask, choose, times_to_new_looks
from jaxsense.mission.state import (
    ATTEMPTS,
    BACKING,
    DRIVING,
    ENDED,
    FACING,
    FAILED,
    IDLE,
    Mission,
    MissionState,
)
from jaxsense.models import Models, make_travel
from jaxsense.sim import viewpoints

_DETOUR = 2.0  # m, detour that a robot prefers to a viewpoint occupied by another
RECOVERY_TIME = 1.0  # s that a robot backs off
AT_VIEWPOINT = 0.05  # m, from a viewpoint within which a robot is there
_REPEATED = 1e3  # m, above any path, for places from which a look tells little


@jax.named_scope("mission.is_due")
def is_due(mission: Mission, state: MissionState, robot: Index) -> Bool[Array, ""]:
    """Whether a robot must decide because it is idle or the map has changed."""
    own = state.robot(robot)
    is_under_way = (own.phase == DRIVING) | (own.phase == FACING)
    has_news = mission.map_of(state, robot).version != own.decided_on
    return (own.phase == IDLE) | (is_under_way & has_news)


@jax.named_scope("mission.choices")
def choices(
    keys: Key,
    mission: Mission,
    models: Models,
    states: MissionState,
    robot: Index,
    policy: Int[Array, ""],
) -> Int[Array, " B"]:
    """What a robot chooses in each of B missions that have the same policy."""
    policies = [*mission.policies.values()]
    known = jax.vmap(lambda state: known_to(mission, models, state, robot))(states)
    # The choice of the policy outside the batch: inside, all would be asked.
    of_policy = lambda i: jax.vmap(lambda k, x: ask(k, policies[i], models, x))(keys, known)  # noqa: E731
    opinions = call(of_policy, policy, len(policies))
    return jax.vmap(functools.partial(choose, mission.config.mission))(opinions, known)


@jax.named_scope("mission.set_out")
def set_out(
    mission: Mission, models: Models, state: MissionState, robot: Index, chosen: Int[Array, ""]
) -> MissionState:
    """Sets out for a viewpoint of the PoI that a robot has chosen, if a decision is due."""
    own, config, num_pois = state.robot(robot), mission.config, mission.config.arena.num_pois
    decides = is_due(mission, state, robot)
    action = jnp.where(decides, chosen, own.target)
    is_new, poi = action != own.target, jnp.minimum(action, num_pois - 1)
    wants = decides & ((own.phase == IDLE) | is_new) & (action >= 0) & (action < num_pois)

    # Failures belong to one target.
    excluded, attempts = jnp.where(is_new, False, own.excluded), jnp.where(is_new, 0, own.attempts)
    found = _best_view(mission, models, state, robot, action, excluded)
    is_exhausted, no_path = found.length >= _REPEATED, ~jnp.isfinite(found.length)
    sets_out = wants & ~is_exhausted & ~found.waits
    exhausts = wants & is_exhausted & ~no_path
    # Robots that wait for each other make room.
    backs_off, time = wants & found.waits, mission.time(state)
    attempts += backs_off
    gives_up = (wants & no_path) | (backs_off & (attempts >= ATTEMPTS))

    # Obstacles may have moved: before it ends, a robot retries the PoIs where it was stuck.
    nothing_left = decides & (action == num_pois)
    position = state.believed_poses[robot, :2]
    stuck_at = own.unreachable & roadmap.reachable(
        config, state.scene.layout, state.roadmap, position
    )
    tries_again = nothing_left & jnp.any(stuck_at) & ~own.tried_again
    given_up = own.unreachable & ~(stuck_at & tries_again)

    # Looks from the current position are not goals; an unreachable PoI is a missed goal.
    num_views = state.roadmap.viewpoints.shape[1]
    is_goal = (sets_out & (found.view < num_views)) | gives_up
    was_needless = decides & is_new & (own.phase == DRIVING) & (own.view < num_views)
    to_view = state.roadmap.to_viewpoint(poi, jnp.minimum(found.view, num_views - 1))
    ends, waits = nothing_left & ~tries_again, gives_up | exhausts | tries_again
    return state.with_robot(
        robot,
        phase=jnp.select(
            [action < 0, ends, sets_out, waits, backs_off],
            [FAILED, ENDED, DRIVING, IDLE, BACKING],
            own.phase,
        ),
        target=action,
        view=jnp.where(sets_out, found.view, own.view),
        to_view=jnp.where(sets_out, to_view, own.to_view),
        decided_on=jnp.where(decides, mission.map_of(state, robot).version, own.decided_on),
        excluded=jnp.where(decides, found.excluded, own.excluded),
        attempts=attempts,
        backs_off_until=jnp.where(backs_off, time + RECOVERY_TIME, own.backs_off_until),
        unreachable=jnp.where(gives_up, given_up.at[poi].set(True), given_up),
        exhausted=own.exhausted.at[poi].set(own.exhausted[poi] | exhausts),
        tried_again=own.tried_again | tries_again,
        path_left=jnp.where(sets_out, found.length, own.path_left),
        progress_at=jnp.where(sets_out, time, own.progress_at),
        goals=own.goals + is_goal - was_needless,
    )


def known_to(mission: Mission, models: Models, state: MissionState, robot: Index) -> Known:
    """Knowledge of a robot that chooses, without the PoIs it has given up."""
    mine, phase, own = state.robot(robot), state.robots.phase, mission.map_of(state, robot)
    known = own.read(models)
    team = Team(
        positions=state.scene.layout.position,
        present=~(mine.unreachable | mine.undetected | mine.exhausted),
        poses=state.believed_poses,
        modality=mission.modalities,
        works=(phase != ENDED) & (phase != FAILED),
        target=state.robots.target,
    )
    pois = jnp.arange(mission.config.arena.num_pois)
    of_pose = lambda pose, poi, m: own.apart(pose[None, :2], poi, m)[0]  # noqa: E731
    of_pois = jax.vmap(of_pose, (None, 0, None))
    apart = jax.vmap(of_pois, (0, None, 0))(team.poses, pois, team.modality)
    return Known(
        belief=known.belief,
        looks=known.times_seen,
        log_posterior=known.log_posterior,
        team=team,
        times=times_to_new_looks(make_travel(mission.config), models.novelty, team, apart),
        robot=jnp.asarray(robot),
    )


@pytree
class _View:
    """A viewpoint to look at a PoI from.

    Attributes:
      view: V for the robot's current position.
      length: metres of the path there, `_REPEATED` and more if no look from anywhere is new.
      excluded: none if all from which a look is new have been.
      waits: whether all of these have been, and robots still occupy some of them.
    """

    view: Int[Array, ""]
    length: Float[Array, ""]
    excluded: Bool[Array, " W"]
    waits: Bool[Array, ""]


@jax.named_scope("mission.best_view")
def _best_view(
    mission: Mission,
    models: Models,
    state: MissionState,
    robot: Index,
    target: Int[Array, ""],
    excluded: Bool[Array, " W"],
) -> _View:
    """Nearest viewpoint of a PoI from which a look is new."""
    config, scene = mission.config, state.scene
    poi = jnp.minimum(target, config.arena.num_pois - 1)
    position, modality = state.believed_poses[robot, :2], mission.modalities[robot]
    length = roadmap.lengths(config, scene.layout, state.roadmap, position, poi)
    positions = state.roadmap.viewpoints[poi]
    is_free = _room(mission, state, robot, poi, positions, MARGIN) > 0
    length += jnp.where(is_free, 0.0, _DETOUR)
    here = jnp.where(sees(mission, state, robot, poi), 0.0, jnp.inf)
    known = mission.map_of(state, robot)
    apart = known.apart(jnp.concatenate([positions, position[None]]), poi, modality)
    is_new = models.novelty.to_go(apart, modality) <= 0
    # A robot at a viewpoint would look from where it stands.
    is_away = jnp.linalg.norm(positions - position[None], axis=-1) > AT_VIEWPOINT
    is_new &= jnp.append(is_away, True) | is_new[-1]
    cost = jnp.append(length, here) + jnp.where(is_new, 0.0, _REPEATED)
    # A PoI is exhausted where no look is new, not while the new ones are excluded.
    left = (cost < _REPEATED) & ~excluded
    excluded &= jnp.any(left)
    is_taken_new = (cost[:-1] < _REPEATED) & ~is_free
    cost = jnp.where(excluded, jnp.inf, cost)
    view = jnp.argmin(cost)
    return _View(view, cost[view], excluded, waits=~jnp.any(left) & jnp.any(is_taken_new))


def is_taken(
    mission: Mission, state: MissionState, robot: Index, poi: Int[Array, ""], view: Int[Array, ""]
) -> Bool[Array, ""]:
    """Whether another robot stands at a viewpoint or in the view from it."""
    position = state.roadmap.viewpoints[poi, view][None]
    return _room(mission, state, robot, poi, position, MARGIN)[0] <= 0


def sees(
    mission: Mission, state: MissionState, robot: Index, poi: Int[Array, ""]
) -> Bool[Array, ""]:
    """Whether a PoI is in range of a robot and no static object occludes it."""
    config, position = mission.config, state.believed_poses[robot, :2]
    distance = jnp.linalg.norm(state.scene.layout.position[poi] - position)
    # A robot may be nearer than it believes.
    nearer = config.mission.localisation.search[0]
    in_range = distance >= config.viewpoint.min_distance + nearer
    in_range &= distance <= config.navigation.view_range
    return in_range & (_room(mission, state, robot, poi, position[None], 0.0)[0] > 0)


def _room(
    mission: Mission,
    state: MissionState,
    robot: Index,
    poi: Int[Array, ""],
    positions: Float[Array, "C 2"],
    margin: float,
) -> Float[Array, " C"]:
    """Free room around positions to look at a PoI from, see `viewpoints.free_room`."""
    standing, layout = state.standing_robots(robot), state.scene.layout
    x, y = positions[:, 0], positions[:, 1]
    return viewpoints.free_room(x, y, margin, mission.config.arena, layout, standing, poi)
