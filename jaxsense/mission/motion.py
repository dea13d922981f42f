"""The robots' motion in one control period, in MJX."""

import dataclasses

import jax
import jax.numpy as jnp
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


def move(mission: Mission, state: MissionState) -> tuple[MissionState, jax.Array]:
    """One control period of physics.

    Contacts cost ten times as much as all the rest, and the planner sees to it that there are none.
    As long as no robot is near enough to anything to touch it within the period, the same arena
    without contacts is integrated, which gives the same motion. Under `vmap` that is decided for
    the whole batch at once; under two of them contacts are always computed.

    Returns:
      The next state, and `[]` the smallest free distance around any robot in the period, in metres.
    """
    config, robots, layout = mission.config, state.robots, state.scene.layout
    motion = _Motion(
        state.scene.poses, state.velocity, state.warmstart, robots.command, jnp.full((), jnp.inf)
    )
    inputs = motion, robots.wanted, layout
    # Two robots that drive at each other, and a margin for what the wheels lag behind.
    reach = 2 * amiro.MAX_SPEED * config.mission.control_period + 0.005

    def is_near(motion: _Motion, wanted: jax.Array, layout: Layout) -> jax.Array:
        return jnp.any(navigation.clearance(config.arena, layout, motion.poses) < reach)

    def touching(*inputs) -> _Motion:
        return _integrate(mission, mission.world.arena, *inputs)

    def free(*inputs) -> _Motion:
        return _integrate(mission, mission.free_arena, *inputs)

    @jax.custom_batching.custom_vmap
    def integrate(inputs) -> _Motion:
        return jax.lax.cond(is_near(*inputs), touching, free, *inputs)

    @integrate.def_vmap
    def _(size: int, is_batched, inputs):
        inputs = jax.tree.map(
            lambda x, b: x if b else jnp.broadcast_to(x, (size, *jnp.shape(x))),
            inputs,
            is_batched[0],
        )
        any_near = jnp.any(jax.vmap(is_near)(*inputs))
        motion = jax.lax.cond(any_near, jax.vmap(touching), jax.vmap(free), *inputs)
        return motion, jax.tree.map(lambda _: True, motion)

    motion = integrate(inputs)
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
    still = arenas.place(arena, layout, motion.poses)

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
