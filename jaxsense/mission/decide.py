"""Choosing the PoI that a robot looks at next, and the viewpoint."""

import dataclasses

import jax
import jax.numpy as jnp

from jaxsense.config import KNOW_WAYS, POLICIES
from jaxsense.core import networks
from jaxsense.core.types import Belief, Index, Key, others
from jaxsense.dqn import belief_mdp, policies, rules, team_mdp
from jaxsense.dqn.team_mdp import Team
from jaxsense.mission import roadmap
from jaxsense.mission.state import (
    BACKING,
    DRIVING,
    ENDED,
    FACING,
    FAILED,
    IDLE,
    LATENT,
    Mission,
    MissionState,
    now,
    robot_of,
    with_robot,
)
from jaxsense.models import Models, expected, expected_gains
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
    values = _values(key, mission, models, state, robot, given_up)
    of_pois = jnp.where(given_up, -jnp.inf, values[:num_pois])
    is_best = (of_pois >= jnp.max(of_pois) - _equal_values(mission, state)) & (
        of_pois > values[num_pois]
    )

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


def _equal_values(mission: Mission, state: MissionState) -> jax.Array:
    """`[]` difference of values that counts as none; 0 where ways are part of the values."""
    knows_ways = [name in KNOW_WAYS for name in POLICIES]
    if mission.config.dqn.task == "team":
        knows_ways[LATENT] = True
    of_policy = jnp.where(jnp.array(knows_ways), 0.0, mission.config.mission.equal_values)
    return of_policy[state.policy]


def _values(
    key: Key,
    mission: Mission,
    models: Models,
    state: MissionState,
    robot: Index,
    given_up: jax.Array,
) -> jax.Array:
    """`[N + 1]` values of the policy's actions, NOP's last."""
    num_pois = mission.config.arena.num_pois
    exact, is_seen = jnp.exp(state.log_posterior), jnp.any(state.seen, axis=-1)
    modalities = jnp.array(mission.config.modality_of_robot)
    modality = modalities[robot]
    of_each = jax.tree.map(lambda *x: jnp.stack(x), *models.look_values)
    looks = jax.tree.map(lambda x: x[modality], of_each)
    known = models.readout, models.look_values, state.belief, is_seen
    gains = expected_gains(*known)[modalities]
    times = state.times_seen[:, modality]
    team = team_of(mission, state, given_up)
    ways = team_mdp.ways(mission.config.team.travel, team)
    by_rule = gains, ways, team, jnp.asarray(robot)

    of_pois = {
        "greedy": gains[robot],
        "bayes": expected(looks.gain, looks.first_gain, exact, is_seen),
        "optimal": expected(looks.total, looks.first_total, exact, is_seen),
        "naive": jnp.where(times < 1, 1.0, -1.0),
        "naive_2": jnp.where(times < 2, 1.0, -1.0),
        "naive_3": jnp.where(times < 3, 1.0, -1.0),
    }
    values = {
        "latent": _q_values(mission, models, state, robot, given_up),
        **{name: jnp.append(each, 0.0) for name, each in of_pois.items()},
        "nearest": rules.nearest(*by_rule),
        "auction": rules.auction(*by_rule),
        "rollout": rules.rollout(*by_rule),
        "random": jax.nn.one_hot(jax.random.randint(key, (), 0, num_pois + 1), num_pois + 1),
    }
    return jnp.stack([values[name] for name in POLICIES])[state.policy]


def _q_values(
    mission: Mission, models: Models, state: MissionState, robot: Index, given_up: jax.Array
) -> jax.Array:
    """`[N + 1]` values of the trained policy."""
    modality = jnp.array(mission.config.modality_of_robot)[robot]
    q_network = jax.tree.map(lambda *x: jnp.stack(x)[modality], *models.q_networks)

    if mission.config.dqn.task == "team":
        known = state.belief, team_of(mission, state, given_up), jnp.asarray(robot)
        config, number = mission.config, len(mission.config.modalities)
        trained = q_network, models.tours
        return policies.tour_values(*trained, *known, number, config.team, config.dqn)
    network = policies.q_network(mission.config.arena.num_pois, mission.config.dqn.hidden)

    def values_if(sure: Belief) -> jax.Array:
        """The network's values as if all PoIs given up were known to be of one class."""
        known = jax.tree.map(
            lambda entry, sure: jnp.where(given_up[:, None], sure[None], entry), state.belief, sure
        )
        return networks.apply(network, q_network, belief_mdp.observation(known))

    # The network would count on learning more about a PoI given up. Of a known one nothing is left
    # to learn; since its class is unknown, all classes count alike.
    return jnp.mean(jax.vmap(values_if)(models.class_beliefs), axis=0)


def team_of(mission: Mission, state: MissionState, given_up: jax.Array) -> Team:
    """Everybody's place as the travel model knows it, without PoIs `[N]` that are given up."""
    phase = state.robots.phase
    return Team(
        positions=state.scene.layout.position,
        present=~given_up,
        poses=state.scene.poses,
        modality=jnp.array(mission.config.modality_of_robot),
        works=(phase != ENDED) & (phase != FAILED),
        target=state.robots.target,
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
