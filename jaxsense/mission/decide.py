"""The choice of the PoI that a robot looks at next, and of the viewpoint.

With `mission.auctions`, a policy says which looks pay, and an auction over travel times divides
them among the robots. Without, and where values include travel time, the highest value decides.
`ask` and `choose` read nothing but what a robot knows, so that `python -m jaxsense.export` takes
them along.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxsense.config.mission import MARGIN, MissionConfig
from jaxsense.core.types import Index, Key, call, pytree
from jaxsense.dqn.policies import Known, Policy, Values, auction
from jaxsense.dqn.team import Team, Travel
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
from jaxsense.vae.novelty import Novelty

_KEPT, _HEADED_FOR = -1e4, 1e2  # m, larger than any distance
_DETOUR = 2.0  # m, detour that a robot prefers to a viewpoint occupied by another
RECOVERY_TIME = 1.0  # s that a robot backs off
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
    of_policy = lambda i: jax.vmap(lambda k, x: ask(k, policies[i], models, x))(keys, known)  # noqa: E731
    opinions = call(of_policy, policy, len(policies))
    return jax.vmap(functools.partial(choose, mission.config.mission))(opinions, known)


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
    pois = jnp.arange(mission.config.arena.num_pois)
    of_pose = lambda pose, poi, m: me.map.apart(pose[None, :2], poi, m)[0]  # noqa: E731
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
class Opinion:
    """What a policy says to a robot that chooses.

    Attributes:
      values: of the A = N + 1 actions, NOP's last.
      gains: of each robot's look at each PoI: above 0 if it pays.
      counts_time: see `Policy`.
      is_unordered: see `Policy`; without it, the gains are 0.
    """

    values: Float[Array, " A"]
    gains: Float[Array, "R N"]
    counts_time: Bool[Array, ""]
    is_unordered: Bool[Array, ""]


@jax.named_scope("mission.ask")
def ask(key: Key, policy: Policy, models: Models, known: Known) -> Opinion:
    """Asks a policy."""

    def of_robots(function: Values) -> Float[Array, "R _"]:
        of_one = lambda robot: function(key, models, dataclasses.replace(known, robot=robot))  # noqa: E731
        return jax.vmap(of_one)(jnp.arange(known.times.shape[0]))

    if policy.is_unordered and policy.worth is None:
        all_values = of_robots(policy.values)
        values, gains = all_values[known.robot], all_values[:, :-1] - all_values[:, -1:]
    else:
        values = policy.values(key, models, known)
        worth = policy.worth if policy.is_unordered else None
        gains = of_robots(worth) if worth else jnp.zeros(known.times.shape)
    return Opinion(
        values=values,
        gains=gains,
        counts_time=jnp.bool_(policy.counts_time(models)),
        is_unordered=jnp.bool_(policy.is_unordered),
    )


@jax.named_scope("mission.choose")
def choose(settings: MissionConfig, opinion: Opinion, known: Known) -> Int[Array, ""]:
    """PoI that a robot chooses, N for NOP, or -1 if any value is NaN."""
    values, present = opinion.values, known.team.present
    # Values that include travel time need no order.
    tolerance = jnp.where(opinion.counts_time, 0.0, settings.equal_values)
    of_pois, of_nop = jnp.where(present, values[:-1], -jnp.inf), values[-1]
    is_best = (of_pois >= jnp.max(of_pois) - tolerance) & (of_pois > of_nop)
    by_values = _by_values(known, is_best)
    by_auction = jnp.argmax(auction(opinion.gains, known.times, known.team, known.robot))
    is_auction = settings.auctions & opinion.is_unordered & ~opinion.counts_time
    choice = jnp.where(is_auction, by_auction, by_values)
    is_nan = jnp.any(jnp.isnan(of_pois)) | jnp.isnan(of_nop)
    return jnp.where(is_nan, -1, choice).astype(jnp.int32)


def times_to_new_looks(
    travel: Travel, novelty: Novelty, team: Team, apart: Float[Array, "R N K"]
) -> Float[Array, "R N"]:
    """Seconds until each robot has looked at each PoI from where a look is new.

    Args:
      apart: distances of each robot from earlier looks by its sensor at each PoI, in metres;
        infinite for none.
    """
    metres = jax.vmap(novelty.to_go)(apart, team.modality)
    return travel.times(team) + metres / travel.speed


def _by_values(known: Known, is_best: Bool[Array, " N"]) -> Int[Array, ""]:
    """One of the PoIs with the best values, by the rules; N if there is none."""
    team, robot = known.team, known.robot
    distance = jnp.linalg.norm(team.positions - team.poses[robot, :2][None], axis=-1)
    # Prefer the robot's present target, then PoIs that no other robot heads for, then near ones.
    rank = distance + _KEPT * team.heads[robot] + _HEADED_FOR * team.is_taken(robot)
    poi = jnp.argmin(jnp.where(is_best, rank, jnp.inf))
    return jnp.where(jnp.any(is_best), poi, distance.shape[0])


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
