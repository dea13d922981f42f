"""The robots' motion in one control period, in MJX."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from mujoco import mjx

from jaxsense.mission.state import Mission, MissionState
from jaxsense.sim import amiro, navigation
from jaxsense.sim import arena as arenas
from jaxsense.sim.arena import Arena, Layout


@struct.dataclass
class _Motion:
    """What the physics carries: `[R, 3]` poses, velocities, warmstart, `[R, 2]` commands."""

    poses: jax.Array
    velocity: jax.Array
    warmstart: jax.Array
    command: jax.Array
    clearance: jax.Array


def move(
    mission: Mission, state: MissionState, axis: str | None = None
) -> tuple[MissionState, jax.Array]:
    """One control period of physics.

    Contacts cost several times as much as all the rest, and the planner sees to it that there are
    none. As long as no robot is near enough to anything to touch it within the period, the robots
    are integrated in an empty arena, which gives the same motion.

    Args:
      mission: the mission.
      state: its present state.
      axis: name of the `vmap` that this is under. The choice is then made for the whole batch at
        once; under a `vmap` without a name contacts are always computed.

    Returns:
      The next state, and `[]` the smallest free distance around any robot in the period, in metres.
    """
    config, robots, layout = mission.config, state.robots, state.scene.layout
    motion = _Motion(
        state.scene.poses, state.velocity, state.warmstart, robots.command, jnp.full((), jnp.inf)
    )
    # Two robots that drive at each other, and a margin for what the wheels lag behind.
    reach = 2 * amiro.MAX_SPEED * config.mission.control_period + 0.005
    is_near = jnp.any(navigation.clearance(config.arena, layout, motion.poses) < reach)
    if axis is not None:
        is_near = jax.lax.pmax(is_near.astype(jnp.int32), axis) > 0

    motion = jax.lax.cond(
        is_near,
        functools.partial(_integrate, mission, mission.world.arena),
        functools.partial(_integrate, mission, mission.free_arena),
        *(motion, robots.wanted, layout),
    )
    state = dataclasses.replace(
        state,
        scene=dataclasses.replace(state.scene, poses=motion.poses),
        velocity=motion.velocity,
        warmstart=motion.warmstart,
        robots=dataclasses.replace(robots, command=motion.command),
        contacts=state.contacts + (motion.clearance < 0),
        least_clearance=jnp.minimum(state.least_clearance, motion.clearance),
    )
    return state, motion.clearance


def _integrate(
    mission: Mission, arena: Arena, motion: _Motion, wanted: jax.Array, layout: Layout
) -> _Motion:
    """Physics steps, in each of which the commands go on towards the wanted ones."""
    is_empty = not np.any(arena.poi_of_geom >= 0)
    still = arena.data if is_empty else arenas.put(arena, layout, motion.poses)

    def substep(motion: _Motion, _) -> tuple[_Motion, None]:
        command = navigation.ramp(motion.command, wanted, arenas.TIMESTEP)
        data: mjx.Data = still.replace(
            qpos=motion.poses.reshape(-1),
            qvel=motion.velocity.reshape(-1),
            qacc_warmstart=motion.warmstart,
        )
        data = arenas.drive(arena, data, navigation.wheel_speeds(command))
        poses = arenas.robot_poses(data)
        clearance = jnp.min(navigation.clearance(arena.config, layout, poses))
        after = _Motion(
            poses=poses,
            velocity=data.qvel.reshape(-1, 3),
            warmstart=data.qacc_warmstart,
            command=command,
            clearance=jnp.minimum(motion.clearance, clearance),
        )
        return after, None

    substeps = round(mission.config.mission.control_period / arenas.TIMESTEP)
    return jax.lax.scan(substep, motion, length=substeps)[0]
