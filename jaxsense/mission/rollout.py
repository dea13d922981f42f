"""Missions from beginning to end, as one scan over control periods."""

import dataclasses

import jax
import jax.numpy as jnp

from jaxsense.mission import act, decide
from jaxsense.mission.motion import move
from jaxsense.mission.state import (
    ENDED,
    FAILED,
    Mission,
    MissionState,
    Record,
    now,
    update_robot,
)
from jaxsense.models import Models
from jaxsense.types import Key


def rollout(
    key: Key, mission: Mission, models: Models, state: MissionState, steps: int
) -> tuple[MissionState, Record]:
    """Some control periods of a mission, as one `lax.scan`.

    Args:
      key: random key.
      mission: the mission.
      models: trained networks.
      state: where to begin.
      steps: how many control periods; static. A mission that is over stays as it is.

    Returns:
      The state after the last one, and the `[steps]` records.
    """
    return jax.lax.scan(
        lambda state, key: step(key, mission, models, state), state, jax.random.split(key, steps)
    )


def play(
    keys: Key, mission: Mission, models: Models, states: MissionState, steps: int
) -> MissionState:
    """`rollout` of many missions, whose states alone are kept; written for the batch to be fast.

    Args:
      keys: `[B]` random keys; each mission goes as `rollout` would with its key.
      mission: the mission.
      models: trained networks.
      states: `[B]` where to begin.
      steps: how many control periods; static.

    Returns:
      The `[B]` states after the last one.
    """
    axis = "missions"
    each = jax.vmap(lambda key, state: step(key, mission, models, state, axis)[0], axis_name=axis)
    step_keys = jnp.swapaxes(jax.vmap(lambda key: jax.random.split(key, steps))(keys), 0, 1)
    return jax.lax.scan(lambda states, keys: (each(keys, states), None), states, step_keys)[0]


def step(
    key: Key, mission: Mission, models: Models, state: MissionState, axis: str | None = None
) -> tuple[MissionState, Record]:
    """One control period: all robots look, decide and set their speeds, then all move.

    `axis` is the name of a batch of missions, see `motion.move`.
    """
    before = state
    looks = state.robots.looks, state.robots.detections
    num_robots = mission.world.arena.num_robots
    # One after the other, so that nobody scans what another one has just made certain.
    state, _ = jax.lax.scan(
        lambda state, robot: (_act(robot[1], mission, models, state, robot[0]), None),
        state,
        (jnp.arange(num_robots), jax.random.split(key, num_robots)),
    )
    state, clearance = move(mission, state, axis)
    robots = state.robots
    is_idle = jnp.all((robots.phase == ENDED) | (robots.phase == FAILED))
    steps = state.steps + 1
    is_late = steps * mission.config.mission.control_period >= mission.config.mission.time_limit
    after = dataclasses.replace(state, steps=steps, is_over=is_idle | is_late)
    state = jax.tree.map(lambda x, y: jnp.where(before.is_over, x, y), before, after)
    record = Record(
        time=state.steps * mission.config.mission.control_period,
        poses=state.scene.poses,
        command=state.robots.command,
        wanted=state.robots.wanted,
        phase=state.robots.phase,
        target=state.robots.target,
        scanned=state.robots.looks > looks[0],
        detected=state.robots.detections > looks[1],
        belief=state.belief,
        seen=state.seen,
        clearance=clearance,
    )
    return state, record


def _act(
    key: Key, mission: Mission, models: Models, state: MissionState, robot: jax.Array
) -> MissionState:
    """What one robot does at the beginning of a control period."""
    choice_key, scan_key = jax.random.split(key)
    stops = now(mission, state) >= state.faults.stops_at[robot]
    robots = state.robots
    fails = stops & (robots.phase[robot] != ENDED)
    state = update_robot(
        state,
        robot,
        phase=jnp.where(fails, FAILED, robots.phase[robot]),
        target=jnp.where(fails, mission.config.arena.num_pois, robots.target[robot]),
    )
    state = decide.decide(choice_key, mission, models, state, robot)
    state = act.approach(mission, state, robot)
    return act.scan(scan_key, mission, models, state, robot)
