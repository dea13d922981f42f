"""Physics of one control period, in MJX."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float
from mujoco import mjx

from jaxsense.config import CONTROL_PERIOD, ArenaConfig, Config
from jaxsense.core.types import pytree
from jaxsense.mission import navigation
from jaxsense.mission.groups import where_due
from jaxsense.mission.state import Mission, MissionState
from jaxsense.sim import amiro
from jaxsense.sim import arena as arenas
from jaxsense.sim.arena import Arena, Layout


@pytree
class _Motion:
    """Physics of B missions, and the smallest free distance [m] so far."""

    poses: Float[Array, "B R 3"]
    velocity: Float[Array, "B R 3"]
    warmstart: Float[Array, "B V"]
    command: Float[Array, "B R 2"]
    clearance: Float[Array, " B"]


@jax.named_scope("mission.move")
def move(mission: Mission, states: MissionState) -> tuple[MissionState, Float[Array, " B"]]:
    """Simulates one control period of B missions side by side.

    Contacts cost several times as much as everything else, and the planner avoids them. All robots
    move in an empty arena, and once more among PoIs and walls in the missions where one can touch
    anything within the period. In the others, both would result in the same motion.

    Args:
      mission: the mission.
      states: `[B]` current states.

    Returns:
      The `[B]` next states, and `[B]` the smallest free distance around any robot in the period, in
      metres.
    """
    config, robots, layout = mission.config, states.robots, states.scene.layout
    poses = states.scene.poses
    far = jnp.full(poses.shape[0], jnp.inf)
    motion = _Motion(poses, states.velocity, states.warmstart, robots.command, far)
    is_near = _is_near(config, layout, poses) & ~states.done
    inputs = motion, robots.wanted, layout
    free = _integrate(mission, mission.free_arena, *inputs)
    among = lambda rows, _: _integrate(mission, mission.world.arena, *rows)  # noqa: E731
    motion = where_due(is_near, among, free, inputs)
    states = dataclasses.replace(
        states,
        scene=dataclasses.replace(states.scene, poses=motion.poses),
        velocity=motion.velocity,
        warmstart=motion.warmstart,
        robots=dataclasses.replace(robots, command=motion.command),
        contacts=states.contacts + (motion.clearance < 0),
        min_clearance=jnp.minimum(states.min_clearance, motion.clearance),
    )
    return states, motion.clearance


def _is_near(config: Config, layout: Layout, poses: Float[Array, "B R 3"]) -> Bool[Array, " B"]:
    """Whether any robot can touch anything within the period."""
    # Two robots may drive at each other; with a margin for the lag of the wheels.
    reach, lag = amiro.MAX_SPEED * CONTROL_PERIOD, 0.005
    around = functools.partial(navigation.clearances, config.arena)
    to_fixed, to_robot = jax.vmap(around)(layout, poses)
    return jnp.any((to_fixed < reach + lag) | (to_robot < 2 * reach + lag), axis=-1)


@jax.named_scope("mission.clearance")
def _clearance(
    config: ArenaConfig, layout: Layout, poses: Float[Array, "B R 3"]
) -> Float[Array, " B"]:
    """Smallest free distance around any robot, in metres."""
    around = jax.vmap(lambda layout, poses: navigation.clearance(config, layout, poses))
    return jnp.min(around(layout, poses), axis=-1)


@jax.named_scope("mission.integrate")
def _integrate(
    mission: Mission,
    arena: Arena,
    motion: _Motion,
    wanted: Float[Array, "B R 2"],
    layout: Layout,
) -> _Motion:
    """Makes the physics steps, in each of which the commands approach the wanted ones."""

    def place_pois(layout: Layout, poses: jax.Array) -> tuple[jax.Array, jax.Array]:
        data = arenas.put(arena, layout, poses)
        return data.mocap_pos, data.mocap_quat

    placed = jax.vmap(place_pois)(layout, motion.poses)

    def step(motion: _Motion, wanted: jax.Array, placed: tuple[jax.Array, jax.Array]) -> _Motion:
        """Makes one physics step of one mission."""
        command = navigation.ramp(motion.command, wanted, arenas.TIMESTEP)
        data: mjx.Data = arena.data.replace(
            mocap_pos=placed[0],
            mocap_quat=placed[1],
            qpos=motion.poses.reshape(-1),
            qvel=motion.velocity.reshape(-1),
            qacc_warmstart=motion.warmstart,
        )
        data = arenas.drive(arena, data, navigation.wheel_speeds(command))
        return _Motion(
            poses=arenas.robot_poses(data),
            velocity=data.qvel.reshape(-1, 3),
            warmstart=data.qacc_warmstart,
            command=command,
            clearance=motion.clearance,
        )

    def substep(motion: _Motion, _) -> tuple[_Motion, None]:
        # The batch inside the loop: a loop inside a batch is traced over and over.
        after = jax.vmap(step)(motion, wanted, placed)
        clearance = _clearance(arena.config, layout, after.poses)
        smallest = jnp.minimum(motion.clearance, clearance)
        return dataclasses.replace(after, clearance=smallest), None

    substeps = round(CONTROL_PERIOD / arenas.TIMESTEP)
    return jax.lax.scan(substep, motion, length=substeps)[0]
