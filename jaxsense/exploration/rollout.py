"""Missions in unknown places, as one scan over control periods."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsense.config.mission import CONTROL_PERIOD
from jaxsense.core import checks
from jaxsense.core.types import Index, Key, within_a_turn
from jaxsense.dqn.policies import Values
from jaxsense.exploration import decide
from jaxsense.exploration import grid as grids
from jaxsense.exploration.sensing import sense
from jaxsense.exploration.state import NUM_FRONTIERS, ExplorationState
from jaxsense.mission import navigation
from jaxsense.mission.act import STUCK_TIME, where_due
from jaxsense.mission.decide import RECOVERY_TIME
from jaxsense.mission.rollout import drifted, move
from jaxsense.mission.state import Mission
from jaxsense.models import Models
from jaxsense.sim import localisation

SENSING_PERIODS = 5
"""Control periods between two scans of a robot."""
_DECIDING_PERIODS = 20  # of control, after which a robot chooses anew
_GIVEN_UP = 0.5  # m, around a frontier
_IDLE_TIME = 2.95  # s without anything to do for all robots, after which a mission ends
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
    return jnp.where(state.is_at_goal(robot) & ~backs_off, turn, drive)


def _progressed(mission: Mission, state: ExplorationState, robot: Index) -> ExplorationState:
    """Notes whether a robot gets nearer to its goal; one that does not backs off, and reconsiders.

    It reconsiders, too, once it has turned to a frontier, or if its slot has been cleared. A
    viewpoint that it has not reached is one of a failed look. Floor at a frontier that it has still
    not seen, or not reached, is given up.
    """
    robots, pose = state.robots, state.believed_poses[robot]
    left = decide.lengths_at(state.grid, robots.way[robot], pose[None, :2])[0]
    off = jnp.abs(within_a_turn(robots.goal[robot, 2] - pose[2]))
    there = state.is_at_goal(robot)
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
    return state.with_failure(robot, modality, gives_up, place).with_robot(
        robot,
        left=jnp.where(is_stuck, jnp.inf, jnp.where(progresses, left, robots.left[robot])),
        progress_at=jnp.where(notes, state.time, robots.progress_at[robot]),
        backs_off_until=until,
        reconsiders=robots.reconsiders[robot] | is_stuck | ends | is_gone,
    )
