"""Missions from beginning to end, as one scan over control periods."""

import dataclasses
import functools
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int
from mujoco import mjx

from jaxsense.config import Config
from jaxsense.config.mission import CONTROL_PERIOD
from jaxsense.core import checks
from jaxsense.core.types import Index, Key, pytree
from jaxsense.mission import act, decide, navigation
from jaxsense.mission.act import Course, where_due
from jaxsense.mission.state import (
    ENDED,
    FAILED,
    Mission,
    MissionState,
    Record,
    Robots,
)
from jaxsense.models import Models
from jaxsense.sim import amiro, localisation
from jaxsense.sim import arena as arenas
from jaxsense.sim.arena import Arena, Layout

States = TypeVar("States", bound=Any)
"""Of missions: what `MissionState` holds of physics, under the same names."""

_MESSAGE_PERIODS = 10  # of control, after which a robot repeats its message


def rollout(
    key: Key, mission: Mission, models: Models, state: MissionState, steps: int
) -> tuple[MissionState, Record]:
    """Runs a mission for some control periods as one `lax.scan`.

    Returns:
      The last state, and the `[steps]` records. For many missions, `rollout_batch` is faster than a
      `vmap` of this.
    """
    checks.require_key(key)
    checks.require_number("steps", steps)
    alone = jax.tree.map(lambda x: jnp.asarray(x)[None], state)
    batch = rollout_batch(key[None], mission, models, alone, steps)
    return jax.tree.map(lambda x: x[0], batch)


@checks.typed
def rollout_batch(
    keys: Key,
    mission: Mission,
    models: Models,
    states: MissionState,
    steps: int,
    recorded: int | None = None,
) -> tuple[MissionState, Record]:
    """Runs B missions side by side, and records some of them.

    Args:
      keys: `[B]` random keys; each mission runs as in `rollout` with its key.
      recorded: how many of the first missions to record; static, all by default.
    """

    def go_on(states: MissionState, keys: Key):
        states, records = step(keys, mission, models, states)
        return states, jax.tree.map(lambda x: x[:recorded], records)

    step_keys = jax.vmap(lambda key: jax.random.split(key, steps), out_axes=1)(keys)
    states, records = jax.lax.scan(go_on, states, step_keys)
    return states, jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), records)


@jax.named_scope("mission.step")
@checks.typed
def step(
    keys: Key, mission: Mission, models: Models, states: MissionState
) -> tuple[MissionState, Record]:
    """Runs one control period of B missions side by side.

    In each, all robots decide, set their speeds and look, then all move. Policies and sensors run
    only in the missions that need them.
    """
    before = states
    num_robots = mission.world.arena.num_robots
    step_keys = jax.vmap(lambda key: jax.random.split(key, num_robots + 2), out_axes=1)(keys)
    robot_keys, drift_keys, message_keys = step_keys[:-2], step_keys[-2], step_keys[-1]
    # One after the other, so that no robot scans what another has just identified.
    act_each = functools.partial(_act, mission, models)
    all_robots = jnp.arange(num_robots)
    states, courses = jax.lax.scan(act_each, states, (all_robots, robot_keys))
    # All robots at once: nothing that they do here changes where the others are.
    steer = jax.vmap(functools.partial(act.steer, mission), (None, 0, 0))
    wanted = jax.vmap(steer, (0, None, 1))(states, all_robots, courses)
    states = drifted(drift_keys, mission, before, move(mission, states, wanted))
    is_idle, steps = jnp.all(states.robots.phase >= ENDED, axis=-1), states.steps + 1
    is_late = steps * CONTROL_PERIOD >= mission.config.mission.time_limit
    after = dataclasses.replace(states, steps=steps, done=is_idle | is_late)
    after = jax.vmap(lambda key, state: _repeat_messages(key, mission, state))(message_keys, after)
    keep = jax.vmap(jnp.where)
    states = jax.tree.map(lambda x, y: keep(before.done, x, y), before, after)
    records = Record(
        time=states.time,
        poses=states.scene.poses,
        command=states.robots.command,
        phase=states.robots.phase,
        target=states.robots.target,
        scanned=states.robots.looks > before.robots.looks,
        detected=states.robots.detections > before.robots.detections,
        belief=states.belief,
        seen=states.seen,
    )
    return states, records


def _act(
    mission: Mission, models: Models, states: MissionState, turn: tuple[Int[Array, ""], Key]
) -> tuple[MissionState, Course]:
    """Decides, drives and scans with one robot of each of B missions, whose turn it is."""
    robot, keys = turn

    def decided(rows: tuple[Key, MissionState], policy: Int[Array, ""]) -> Robots:
        keys, states = rows
        chosen = decide.choices(keys, mission, models, states, robot, policy)
        set_out = lambda state, action: decide.set_out(mission, models, state, robot, action)  # noqa: E731
        return jax.vmap(set_out)(states, chosen).robots

    choice_keys, scan_keys = jax.vmap(jax.random.split, out_axes=1)(keys)
    states = jax.vmap(lambda state: _fail(mission, state, robot))(states)
    due = jax.vmap(lambda state: decide.is_due(mission, state, robot))(states) & ~states.done
    inputs = choice_keys, states
    robots = where_due(due, decided, states.robots, inputs, kinds=states.policy)
    states = dataclasses.replace(states, robots=robots)
    states, course = jax.vmap(lambda state: act.approach(mission, models, state, robot))(states)
    return act.scan(scan_keys, mission, models, states, robot), course


@jax.named_scope("mission.drift")
def drifted(keys: Key, mission: Mission, before: States, after: States) -> States:
    """The states of B missions with what driving has added to the errors of the robots' poses."""
    way = after.scene.poses[..., :2] - before.scene.poses[..., :2]
    drift = jax.vmap(localisation.drift, (0, None, 0, 0))
    error = drift(
        keys, mission.config.mission.localisation, after.pose_error, jnp.linalg.norm(way, axis=-1)
    )
    return dataclasses.replace(after, pose_error=error)


def _repeat_messages(key: Key, mission: Mission, state: MissionState) -> MissionState:
    """Lets all robots that have not failed tell their looks again, once in a while."""
    if state.memory is None:
        return state
    sends = (state.steps % _MESSAGE_PERIODS == 0) & (state.robots.phase != FAILED)
    settings = mission.config.mission.communication
    heard = state.memory.after_messages(key, settings, state.time, sends)
    return dataclasses.replace(state, memory=heard)


def _fail(mission: Mission, state: MissionState, robot: Index) -> MissionState:
    """Stops a robot when its time to fail has come."""
    phase, target = state.robots.phase[robot], state.robots.target[robot]
    fails = (state.time >= state.faults.stops_at[robot]) & (phase < ENDED)
    return state.with_robot(
        robot,
        phase=jnp.where(fails, FAILED, phase),
        target=jnp.where(fails, mission.config.arena.num_pois, target),
    )


@pytree
class _Motion:
    """Physics of B missions."""

    poses: Float[Array, "B R 3"]
    velocity: Float[Array, "B R 3"]
    warmstart: Float[Array, "B V"]
    command: Float[Array, "B R 2"]


@jax.named_scope("mission.move")
def move(mission: Mission, states: States, wanted: Float[Array, "B R 2"]) -> States:
    """Simulates one control period of B missions side by side.

    Contacts cost several times as much as everything else, and the planner avoids them. All robots
    move in an empty arena, and once more among PoIs and walls in the missions where one can touch
    anything within the period. In the others, both would result in the same motion.

    Args:
      wanted: speeds that the robots want, see `act.steer`.
    """
    robots, layout, poses = states.robots, states.scene.layout, states.scene.poses
    motion = _Motion(poses, states.velocity, states.warmstart, robots.command)
    is_near = _is_near(mission.config, layout, poses) & ~states.done
    inputs = motion, wanted, layout
    free = _integrate(mission, mission.free_arena, *inputs)
    among = lambda rows, _: _integrate(mission, mission.world.arena, *rows)  # noqa: E731
    motion, clearance = where_due(is_near, among, free, inputs)
    return dataclasses.replace(
        states,
        scene=dataclasses.replace(states.scene, poses=motion.poses),
        velocity=motion.velocity,
        warmstart=motion.warmstart,
        robots=dataclasses.replace(robots, command=motion.command),
        contacts=states.contacts + (clearance < 0),
    )


def _is_near(config: Config, layout: Layout, poses: Float[Array, "B R 3"]) -> Bool[Array, " B"]:
    """Whether any robot can touch anything within the period."""
    # Two robots may drive at each other; with a margin for the lag of the wheels.
    reach, lag = amiro.MAX_SPEED * CONTROL_PERIOD, 0.005
    around = functools.partial(navigation.clearance, config.arena)
    to_fixed, to_robot = jax.vmap(around)(layout, poses)
    return jnp.any((to_fixed < reach + lag) | (to_robot < 2 * reach + lag), axis=-1)


@jax.named_scope("mission.integrate")
def _integrate(
    mission: Mission,
    arena: Arena,
    motion: _Motion,
    wanted: Float[Array, "B R 2"],
    layout: Layout,
) -> tuple[_Motion, Float[Array, " B"]]:
    """Makes the physics steps, in each of which the commands approach the wanted ones.

    Returns:
      The motion, and the smallest free distance around any robot, in metres.
    """

    def place_pois(layout: Layout, poses: jax.Array) -> tuple[jax.Array, jax.Array]:
        data = arenas.put(arena, layout, poses)
        return data.mocap_pos, data.mocap_quat

    placed = jax.vmap(place_pois)(layout, motion.poses)

    def step(
        motion: _Motion, wanted: jax.Array, placed: tuple[jax.Array, jax.Array], layout: Layout
    ) -> _Motion:
        """Makes one physics step of one mission."""
        command = navigation.ramp(motion.command, wanted, arenas.TIMESTEP)
        data: mjx.Data = arena.data.replace(
            mocap_pos=placed[0],
            mocap_quat=placed[1],
            qpos=motion.poses.reshape(-1),
            qvel=motion.velocity.reshape(-1),
            qacc_warmstart=motion.warmstart,
        )
        sized = arenas.sized(arena, layout)
        data = arenas.drive(sized, data, navigation.wheel_speeds(command))
        return _Motion(
            poses=arenas.robot_poses(data),
            velocity=data.qvel.reshape(-1, 3),
            warmstart=data.qacc_warmstart,
            command=command,
        )

    def substep(motion: _Motion, _) -> tuple[_Motion, Float[Array, " B"]]:
        # The batch inside the loop: a loop inside a batch is traced over and over.
        after = jax.vmap(step)(motion, wanted, placed, layout)
        with jax.named_scope("mission.clearance"):
            around = functools.partial(navigation.clearance, arena.config)
            return after, jnp.min(jnp.minimum(*jax.vmap(around)(layout, after.poses)), axis=-1)

    substeps = round(CONTROL_PERIOD / arenas.TIMESTEP)
    motion, clearances = jax.lax.scan(substep, motion, length=substeps)
    return motion, jnp.min(clearances, axis=0)
