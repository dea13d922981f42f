"""The choice of the PoI that a robot looks at next, and of the viewpoint.

The action of the policy's highest value is taken. Values depend on nothing but what a
robot knows, so that `python -m jaxsense.export` takes them along.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxsense.config.mission import MARGIN
from jaxsense.core.types import Index, Key, call
from jaxsense.dqn.policies import Known, best
from jaxsense.dqn.team import Team, to_go
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
    Robot,
)
from jaxsense.models import Models, make_travel
from jaxsense.sim import viewpoints

_KEPT, _HEADED_FOR = -1e4, 1e2  # m, larger than any distance
_DETOUR = 2.0  # m, detour that a robot prefers to a viewpoint occupied by another
RECOVERY_TIME = 0.95  # s that a robot backs off; between control periods, as in `act`
AT_VIEWPOINT = 0.05  # m, from a viewpoint within which a robot is there
_REPEATED = 1e3  # m, above any path, for places from which a look tells little


@jax.named_scope("mission.is_due")
def is_due(mission: Mission, state: MissionState, robot: Index) -> Bool[Array, ""]:
    """Whether a robot must decide because it is idle or the map has changed."""
    phase, decided_on = state.robots.phase[robot], state.robots.decided_on[robot]
    is_under_way = (phase == DRIVING) | (phase == FACING)
    has_news = mission.map_of(state, robot).version != decided_on
    return (phase == IDLE) | (is_under_way & has_news)


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
    of_policy = lambda i: jax.vmap(lambda key, x: policies[i](key, models, x))(keys, known)  # noqa: E731
    return jax.vmap(action_of)(call(of_policy, policy, len(policies)), known)


@jax.named_scope("mission.set_out")
def set_out(
    mission: Mission, models: Models, state: MissionState, robot: Index, action: Int[Array, ""]
) -> MissionState:
    """Sets out for a viewpoint of the PoI that a robot has chosen."""
    me, num_pois = Robot(mission, state, robot), mission.config.arena.num_pois
    own, time, num_views = me.own, state.time, state.roadmap.viewpoints.shape[1]
    is_new, poi = action != own.target, jnp.minimum(action, num_pois - 1)
    wants = ((own.phase == IDLE) | is_new) & (action >= 0) & (action < num_pois)

    # Failures belong to one target.
    excluded, attempts = own.excluded & ~is_new, jnp.where(is_new, 0, own.attempts)
    lengths = state.roadmap.lengths(me.pose[:2])
    view, length, excluded, is_taken = _best_view(me, models, poi, lengths[poi], excluded)
    is_exhausted, no_path = length >= _REPEATED, ~jnp.isfinite(length)
    sets_out = wants & ~is_exhausted & ~is_taken
    exhausts = wants & is_exhausted & ~no_path
    # Robots that wait for each other make room.
    backs_off = wants & is_taken
    attempts += backs_off
    gives_up = (wants & no_path) | (backs_off & (attempts >= ATTEMPTS))

    # Obstacles may have moved: before it ends, a robot retries the PoIs where it was stuck.
    nothing_left = action == num_pois
    stuck_at = own.unreachable & jnp.any(jnp.isfinite(lengths), axis=-1)
    tries_again = nothing_left & jnp.any(stuck_at) & ~own.tried_again
    given_up = own.unreachable & ~(stuck_at & tries_again)

    # Looks from the current position are not goals; an unreachable PoI is a missed goal.
    is_goal = (sets_out & (view < num_views)) | gives_up
    was_needless = is_new & (own.phase == DRIVING) & (own.view < num_views)
    to_view = state.roadmap.to_viewpoint(poi, jnp.minimum(view, num_views - 1))
    ends, waits = nothing_left & ~tries_again, gives_up | exhausts | tries_again
    is_poi = jnp.arange(num_pois) == poi
    return state.with_robot(
        robot,
        phase=jnp.select(
            [action < 0, ends, sets_out, waits, backs_off],
            [FAILED, ENDED, DRIVING, IDLE, BACKING],
            own.phase,
        ),
        target=action,
        view=jnp.where(sets_out, view, own.view),
        to_view=jnp.where(sets_out, to_view, own.to_view),
        decided_on=me.map.version,
        excluded=excluded,
        attempts=attempts,
        backs_off_until=jnp.where(backs_off, time + RECOVERY_TIME, own.backs_off_until),
        unreachable=given_up | (gives_up & is_poi),
        exhausted=own.exhausted | (exhausts & is_poi),
        tried_again=own.tried_again | tries_again,
        path_left=jnp.where(sets_out, length, own.path_left),
        progress_at=jnp.where(sets_out, time, own.progress_at),
        goals=own.goals + is_goal - was_needless,
    )


def known_to(mission: Mission, models: Models, state: MissionState, robot: Index) -> Known:
    """Knowledge of a robot that chooses, without the PoIs it has given up."""
    me = Robot(mission, state, robot)
    own, known = me.own, me.map.read(models)
    team = Team(
        positions=state.scene.layout.position,
        present=~(own.unreachable | own.undetected | own.exhausted),
        poses=state.believed_poses,
        modality=mission.modalities,
        works=state.robots.phase < ENDED,
        target=state.robots.target,
    )
    travel = make_travel(mission.config)
    apart = lambda place, poi, modality: me.map.apart(place[None], poi, modality)[0]  # noqa: E731
    return Known(
        belief=known.belief,
        looks=known.times_seen,
        log_posterior=known.log_posterior,
        team=team,
        times=travel.times(team, to_go(models.novelty, travel, team, apart)),
        robot=jnp.asarray(robot),
    )


def action_of(values: Float[Array, " A"], known: Known) -> Int[Array, ""]:
    """The action of the highest value among those that exist, N for NOP, or -1 if one is NaN."""
    return best(jnp.where(known.team.action_mask, values, -jnp.inf))


@jax.named_scope("mission.best_view")
def _best_view(
    me: Robot,
    models: Models,
    poi: Int[Array, ""],
    lengths: Float[Array, " V"],
    excluded: Bool[Array, " W"],
) -> tuple[Int[Array, ""], Float[Array, ""], Bool[Array, " W"], Bool[Array, ""]]:
    """Nearest viewpoint of a PoI from which a look is new, by the lengths of paths there.

    Returns:
      The viewpoint, V for the robot's current position; metres of the path there, `_REPEATED` and
      more if no look from anywhere is new; which viewpoints are excluded: none if all from which a
      look is new have been; and whether all of these have been, and robots occupy some of them.
    """
    positions, position = me.state.roadmap.viewpoints[poi], me.pose[None, :2]
    is_free, sees = views(me, poi, positions)
    lengths += jnp.where(is_free, 0.0, _DETOUR)
    here = jnp.where(sees, 0.0, jnp.inf)
    apart = me.map.apart(jnp.concatenate([positions, position]), poi, me.modality)
    is_new = models.novelty.to_go(apart, me.modality) <= 0
    # A robot at a viewpoint would look from where it stands.
    is_away = jnp.linalg.norm(positions - position, axis=-1) > AT_VIEWPOINT
    is_new &= jnp.append(is_away, True) | is_new[-1]
    cost = jnp.append(lengths, here) + jnp.where(is_new, 0.0, _REPEATED)
    # A PoI is exhausted where no look is new, not while the new ones are excluded.
    left = (cost < _REPEATED) & ~excluded
    excluded &= jnp.any(left)
    is_taken_new = (cost[:-1] < _REPEATED) & ~is_free
    cost = jnp.where(excluded, jnp.inf, cost)
    view = jnp.argmin(cost)
    return view, cost[view], excluded, ~jnp.any(left) & jnp.any(is_taken_new)


def views(
    me: Robot, poi: Int[Array, ""], positions: Float[Array, "V 2"]
) -> tuple[Bool[Array, " V"], Bool[Array, ""]]:
    """Which viewpoints of a PoI are free, and whether the robot sees it from where it stands.

    A robot that stands at a viewpoint or in the view from it occupies it.
    """
    config, layout, here = me.mission.config, me.state.scene.layout, me.pose[:2]
    x, y = jnp.concatenate([positions, here[None]]).T
    margin = np.append(np.full(len(positions), MARGIN, np.float32), np.float32(0.0))
    room = viewpoints.free_room(x, y, margin, config.arena, layout, me.standing, poi)
    distance = jnp.linalg.norm(layout.position[poi] - here)
    # A robot may be nearer than it believes.
    nearer = config.mission.localisation.search[0]
    in_range = distance >= config.viewpoint.min_distance + nearer
    in_range &= distance <= config.navigation.view_range
    return room[:-1] > 0, in_range & (room[-1] > 0)
