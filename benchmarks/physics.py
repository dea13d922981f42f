"""Physics steps of two robots among three points of interest, against C MuJoCo's `rollout`."""

import dataclasses
import functools
import os
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from mujoco import mjx

from benchmarks import measure
from benchmarks.measure import Options, Row, Side
from benchmarks.peers import native
from jaxsense import PRESETS, Config, init, mission
from jaxsense.mission import Mission, MissionState, navigation
from jaxsense.mission.motion import move
from jaxsense.mission.rollout import step as mission_step
from jaxsense.run import devices
from jaxsense.sim import amiro
from jaxsense.sim import arena as arenas
from jaxsense.sim.arena import Arena, Layout

_UNIT = "steps/s"
_PEER = {"peer": "mujoco.rollout", "packages": ("mujoco",)}
_FREE_TOLERANCE = 1e-3  # m and rad over 1 s, float32 against float64
_CONTACT_TOLERANCE = 5e-3  # m and rad, for all but one in a hundred, see the tests of the arena
_PERIODS_BEFORE = 40  # 4 s of missions that last 14 s
_MOST_PLAYED = 384  # missions; more are copies of these
_UNTRAINED = dataclasses.replace(
    PRESETS["default"],
    # Untrained detectors are never confident; what they detect does not matter here.
    mission=dataclasses.replace(PRESETS["default"].mission, least_confidence=0.0),
)


@struct.dataclass
class Drives:
    """B drives: where they start and what the wheels are told.

    Attributes:
      layout: `[B, ...]` of the PoIs.
      poses: `[B, R, 3]` in m and rad.
      velocity: `[B, R, 3]` of the poses.
      warmstart: `[B, 3 R]` MJX's last accelerations.
      wheel_speeds: `[B, T, R, 2]` in rad/s, in every step.
    """

    layout: Layout
    poses: jax.Array
    velocity: jax.Array
    warmstart: jax.Array
    wheel_speeds: jax.Array


def physics(options: Options) -> Row:
    """Without contacts: random poses and wheel speeds in an empty arena, as missions have it."""
    batches = measure.batches(options, quick=64, cpu=(256, 1024, 4096), accelerator=(32768, 262144))
    steps = 10 if options.quick else 100
    arena = arenas.build(_UNTRAINED.arena, (False, True), obstacles=False)
    ours, theirs = [], []
    for batch in batches:
        drives = _random_drives(jax.random.key(0), _UNTRAINED, batch, steps)
        ours.append(_drive_side(arena, drives))
        if options.peers and batch == batches[0]:
            theirs = _native_sides(arena, drives)
            _check(devices.joined(ours[-1].run()), theirs[0].run(), _FREE_TOLERANCE, share=1.0)
    return measure.compare("physics", _UNIT, ours, theirs, options, **_PEER)


def physics_contacts(options: Options) -> Row:
    """As in the mission, where the contact solver runs only while a robot is near something."""
    batches, periods = _mission_sizes(options)
    scenario, states = _mid_mission(batches[-1], periods)
    ours = [_move_side(scenario, _first(states, batch)) for batch in batches]
    theirs = []
    if options.peers:
        theirs = _native_sides(scenario.world.arena, _as_drives(states))
        _check(devices.joined(ours[-1].run()), theirs[0].run(), _CONTACT_TOLERANCE, share=0.99)
    return measure.compare("physics_contacts", _UNIT, ours, theirs, options, **_PEER)


def physics_solver(options: Options) -> Row:
    """From the same states, with the contact solver in every step."""
    batches, periods = _mission_sizes(options)
    team, states = _mid_mission(batches[-1], periods)
    arena, drives = team.world.arena, _as_drives(states)
    ours = [_drive_side(arena, _first(drives, batch * periods)) for batch in batches]
    theirs = _native_sides(arena, drives) if options.peers else []
    return measure.compare("physics_solver", _UNIT, ours, theirs, options, **_PEER)


def _mission_sizes(options: Options) -> tuple[tuple[int, ...], int]:
    """Numbers of missions side by side, and control periods of each."""
    batches = measure.batches(options, quick=16, cpu=(64, 384), accelerator=(8192, 65536))
    return batches, 2 if options.quick else 8


def _first(tree: Any, number: int) -> Any:
    return jax.tree.map(lambda x: x[:number], tree)


def _random_drives(key: jax.Array, config: Config, batch: int, steps: int) -> Drives:
    class_key, layout_key, pose_key, wheel_key = jax.random.split(key, 4)
    num_pois, num_robots = config.arena.num_pois, len(config.modalities)
    classes = jax.random.randint(class_key, (batch, num_pois), 0, len(config.arena.classes))
    layout = jax.vmap(lambda k, c: arenas.random_layout(k, config.arena, c))(
        jax.random.split(layout_key, batch), classes
    )
    reach = jnp.array([config.arena.side / 2, config.arena.side / 2, jnp.pi])
    poses = reach[None, None] * jax.random.uniform(pose_key, (batch, num_robots, 3), minval=-1.0)
    limit = amiro.MAX_WHEEL_SPEED
    shape = (batch, steps, num_robots, 2)
    return Drives(
        layout=layout,
        poses=poses,
        velocity=jnp.zeros((batch, num_robots, 3)),
        warmstart=jnp.zeros((batch, 3 * num_robots)),
        wheel_speeds=jax.random.uniform(wheel_key, shape, minval=-limit, maxval=limit),
    )


@functools.cache
def _mid_mission(batch: int, periods: int) -> tuple[Mission, MissionState]:
    """`[B, P]` states that the physics was given in P successive periods of naive missions."""
    scenario = mission.make_mission(_UNTRAINED)
    networks = init(jax.random.key(0), scenario.config)

    def play(keys: jax.Array) -> MissionState:
        reset_keys, play_keys = jax.vmap(jax.random.split, out_axes=1)(keys)
        naive = scenario.policy("naive")
        states = jax.vmap(lambda key: mission.reset(key, scenario, networks, naive))(reset_keys)

        def step(states: MissionState, keys: jax.Array):
            after, _ = mission_step(keys, scenario, networks, states)
            # What the robots decided in this period, from where they stood before it.
            robots = dataclasses.replace(states.robots, wanted=after.robots.wanted)
            return after, dataclasses.replace(states, robots=robots)

        def skip(states: MissionState, keys: jax.Array):
            return step(states, keys)[0], None

        number = _PERIODS_BEFORE + periods
        step_keys = jax.vmap(lambda key: jax.random.split(key, number), out_axes=1)(play_keys)
        states, _ = jax.lax.scan(skip, states, step_keys[:_PERIODS_BEFORE])
        played = jax.lax.scan(step, states, step_keys[_PERIODS_BEFORE:])[1]
        return jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), played)

    fast_to_compile = {"xla_backend_optimization_level": 0}
    record = jax.jit(play, compiler_options=fast_to_compile)
    played = record(jax.random.split(jax.random.key(1), min(batch, _MOST_PLAYED)))
    rows = jnp.arange(batch) % min(batch, _MOST_PLAYED)
    return scenario, jax.tree.map(lambda x: x[rows], played)


def _as_drives(states: MissionState) -> Drives:
    """`[B * P]` drives, each of one control period, with the commands that `move` gives."""
    config = _UNTRAINED.mission
    substeps = round(config.control_period / arenas.TIMESTEP)
    flat: MissionState = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), states)

    def ramp(command: jax.Array, wanted: jax.Array) -> jax.Array:
        def substep(command: jax.Array, _):
            command = navigation.ramp(command, wanted, arenas.TIMESTEP)
            return command, navigation.wheel_speeds(command)

        return jax.lax.scan(substep, command, length=substeps)[1]

    return Drives(
        layout=flat.scene.layout,
        poses=flat.scene.poses,
        velocity=flat.velocity,
        warmstart=flat.warmstart,
        wheel_speeds=jax.jit(jax.vmap(ramp))(flat.robots.command, flat.robots.wanted),
    )


def _drive_side(arena: Arena, drives: Drives) -> Side:
    """Our physics, `arena.drive`, on all devices."""

    def drive(drives: Drives) -> tuple[jax.Array, jax.Array]:
        is_empty = not np.any(arena.poi_of_geom >= 0)
        still = arena.data if is_empty else arenas.put(arena, drives.layout, drives.poses)

        def step(carry, wheel_speeds: jax.Array):
            qpos, qvel, warmstart = carry
            data: mjx.Data = still.replace(qpos=qpos, qvel=qvel, qacc_warmstart=warmstart)
            data = arenas.drive(arena, data, wheel_speeds)
            return (data.qpos, data.qvel, data.qacc_warmstart), None

        start = drives.poses.reshape(-1), drives.velocity.reshape(-1), drives.warmstart
        (qpos, qvel, _), _ = jax.lax.scan(step, start, drives.wheel_speeds)
        return qpos, qvel

    batch, steps = drives.wheel_speeds.shape[:2]
    workers = devices.start(None)
    return measure.compiled(
        jax.vmap(drive), drives, work=batch * steps, batch=batch, workers=workers
    )


def _move_side(scenario: Mission, states: MissionState) -> Side:
    """Our physics as the mission calls it, one period after the other, on all devices."""

    def periods(states: MissionState) -> tuple[jax.Array, jax.Array]:
        by_period = jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), states)
        moved = jax.lax.map(lambda states: move(scenario, states)[0], by_period)
        poses, velocity = moved.scene.poses, moved.velocity
        return tuple(jnp.swapaxes(x, 0, 1) for x in (poses, velocity))  # pyright: ignore

    batch, number = states.steps.shape
    substeps = round(scenario.config.mission.control_period / arenas.TIMESTEP)
    work = batch * number * substeps
    workers = devices.start(None)
    return measure.compiled(periods, states, work=work, batch=batch, workers=workers)


def _native_sides(arena: Arena, drives: Drives) -> list[Side]:
    """C MuJoCo on the same drives, with one thread and more."""
    put = jax.jit(jax.vmap(lambda layout, poses: arenas.put(arena, layout, poses)))
    placed = put(drives.layout, drives.poses)
    control = jax.vmap(jax.vmap(arenas.as_control))(drives.wheel_speeds)
    batch, steps = control.shape[:2]
    inputs = native.RolloutInputs(
        qpos=np.asarray(drives.poses).reshape(batch, -1),
        qvel=np.asarray(drives.velocity).reshape(batch, -1),
        warmstart=np.asarray(drives.warmstart),
        control=np.asarray(control),
        mocap_pos=np.asarray(placed.mocap_pos)[:, : arena.mj_model.nmocap].reshape(batch, -1),
        mocap_quat=np.asarray(placed.mocap_quat)[:, : arena.mj_model.nmocap].reshape(batch, -1),
    )
    cores = os.cpu_count() or 1
    return [
        Side(native.rollout(arena.mj_model, inputs, threads), batch * steps, batch)
        for threads in sorted({1, cores, 2 * cores})
    ]


def _check(ours: tuple[jax.Array, jax.Array], theirs, tolerance: float, share: float) -> None:
    """Raises a `RuntimeError` if fewer than `share` of the last poses agree."""
    poses = np.asarray(ours[0]).reshape(-1)
    error = np.abs(poses - theirs[0].reshape(-1)).reshape(-1, 3).max(axis=-1)
    worst = float(np.quantile(error, share))
    if not worst <= tolerance:
        raise RuntimeError(f"physics differs from C MuJoCo's by {worst} m or rad")
