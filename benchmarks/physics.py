"""Physics steps of two robots among three points of interest, against others who make them."""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import PyTree
from mujoco import mjx

from benchmarks import measure, peers
from benchmarks.measure import Options, Row, Side
from benchmarks.missions import PERIODS_BEFORE, untrained
from benchmarks.peers import native
from jaxsense import Config, init, mission
from jaxsense.config.mission import CONTROL_PERIOD
from jaxsense.mission import Mission, MissionState, navigation
from jaxsense.mission.rollout import move
from jaxsense.mission.rollout import step as mission_step
from jaxsense.run import devices
from jaxsense.run.devices import Workers
from jaxsense.sim import amiro
from jaxsense.sim import arena as arenas
from jaxsense.sim.arena import Arena, Layout

_UNIT = "steps/s"
_FREE_TOLERANCE = 1e-3  # m and rad over 1 s, float32 against float64
_CONTACT_TOLERANCE = 5e-3  # m and rad, for all but one in a hundred, see the tests of the arena
_MOST_PLAYED = 384  # missions; more are copies of these
_UNTRAINED = untrained("default")


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


Played: TypeAlias = tuple[MissionState, jax.Array]
"""States, and the commands of the robots at the end of each period."""

Sides: TypeAlias = Callable[[Arena, Drives], list[Side]]
"""A peer's ways to make the steps of drives, each of which returns the last poses first."""


@dataclasses.dataclass(frozen=True)
class Peer:
    """Somebody else who makes physics steps.

    Attributes:
      name: of its function.
      packages: distributions that it needs.
      load: returns its ways, or None if it is missing or not asked for.
    """

    name: str
    packages: tuple[str, ...]
    load: Callable[[Options], Sides | None]

    def compare(
        self,
        row: str,
        options: Options,
        arena: Arena,
        drives: Sequence[Drives],
        ours: Sequence[Side],
        tolerance: float,
        share: float,
    ) -> Row:
        """The row, after a check that both make the same steps.

        Args:
          row: its name.
          options: whether peers are asked for.
          arena: in which the peer drives.
          drives: of each of our sides.
          ours: our sides.
          tolerance: of poses, in m and rad.
          share: of the drives that must agree.
        """
        sides = self.load(options)
        theirs = [] if sides is None else [side for some in drives for side in sides(arena, some)]
        if theirs:
            _check(ours[0], theirs[0], tolerance, share)
        names = {"peer": self.name, "packages": self.packages}
        return measure.compare(row, _UNIT, ours, theirs, options, **names)


def _native(simulate: Callable[..., Callable[[], PyTree]], options: Options) -> Sides | None:
    return functools.partial(_native_sides, simulate) if options.peers else None


def _warp(options: Options) -> Sides | None:
    warp = peers.load("mujoco_warp", options.peers)
    if warp is None:
        return None

    def sides(arena: Arena, drives: Drives) -> list[Side]:
        others = warp.arenas(arena, batch=len(drives.poses))
        # As our pipeline does it, and as MJX's own examples do.
        return [
            _drive_side(other, drives, devices.ALONE, keeps_data)
            for other in others
            for keeps_data in (False, True)
        ]

    return sides


_ROLLOUT = Peer("mujoco.rollout", ("mujoco",), functools.partial(_native, native.rollout))
_BATCH = Peer("mujoco.batch", ("mujoco",), functools.partial(_native, native.batch))
_WARP = Peer('MJX impl="warp"', ("mujoco-mjx", "warp-lang"), _warp)


def physics(options: Options, row: str = "physics", peer: Peer = _ROLLOUT) -> Row:
    """Without contacts: random poses and wheel speeds in an empty arena, as missions have it."""
    arena, drives = _free_drives(options)
    ours = [_drive_side(arena, some, devices.start(None)) for some in drives]
    return peer.compare(row, options, arena, drives, ours, _FREE_TOLERANCE, share=1.0)


def physics_contacts(options: Options, row: str = "physics_contacts", peer: Peer = _ROLLOUT) -> Row:
    """As in the mission, where the contact solver runs only while a robot is near something."""
    scenario, states = _mid_mission(options)
    arena, drives = scenario.world.arena, [_as_drives(some) for some in states]
    ours = [_move_side(scenario, some) for some in states]
    return peer.compare(row, options, arena, drives, ours, _CONTACT_TOLERANCE, share=0.99)


def physics_solver(options: Options, row: str = "physics_solver", peer: Peer = _ROLLOUT) -> Row:
    """From the same states, with the contact solver in every step."""
    scenario, states = _mid_mission(options)
    arena, drives = scenario.world.arena, [_as_drives(some) for some in states]
    ours = [_drive_side(arena, some, devices.start(None)) for some in drives]
    return peer.compare(row, options, arena, drives, ours, _CONTACT_TOLERANCE, share=0.99)


def physics_batch(options: Options) -> Row:
    """`physics` against `mujoco.batch`."""
    return physics(options, "physics_batch", _BATCH)


def physics_solver_batch(options: Options) -> Row:
    """`physics_solver` against `mujoco.batch`."""
    return physics_solver(options, "physics_solver_batch", _BATCH)


def physics_warp(options: Options) -> Row:
    """`physics` against MJX on Warp."""
    return physics(options, "physics_warp", _WARP)


def physics_contacts_warp(options: Options) -> Row:
    """`physics_contacts` against MJX on Warp, which solves contacts in every step."""
    return physics_contacts(options, "physics_contacts_warp", _WARP)


def physics_solver_warp(options: Options) -> Row:
    """`physics_solver` against MJX on Warp."""
    return physics_solver(options, "physics_solver_warp", _WARP)


def physics_devices(options: Options) -> Row:
    """`physics` on all devices, against one of them."""
    arena, drives = _free_drives(options)
    workers = devices.start(None), devices.start(1)
    ours, theirs = ([_drive_side(arena, some, on) for some in drives] for on in workers)
    return measure.compare("physics_devices", _UNIT, ours, theirs, options, peer="one device")


def _free_drives(options: Options) -> tuple[Arena, list[Drives]]:
    """The empty arena, and drives in it for each size of a batch."""
    batches = measure.batches(options, quick=64, cpu=(256, 1024, 4096), accelerator=(32768, 262144))
    steps = 10 if options.quick else 100
    arena = arenas.build(_UNTRAINED.arena, (False, True), obstacles=False)
    key = jax.random.key(0)
    return arena, [_random_drives(key, _UNTRAINED, batch, steps) for batch in batches]


def _mid_mission(options: Options) -> tuple[Mission, list[Played]]:
    """Inputs `[B, P]` of the physics in missions under way, for each size of a batch."""
    batches = measure.batches(options, quick=16, cpu=(64, 384), accelerator=(8192, 65536))
    scenario, states = _played(batches[-1], periods=2 if options.quick else 8)
    return scenario, [jax.tree.map(lambda x: x[:batch], states) for batch in batches]  # noqa: B023


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
def _played(batch: int, periods: int) -> tuple[Mission, Played]:
    """`[B, P]` inputs of the physics in P successive periods of naive missions."""
    scenario = mission.make_mission(_UNTRAINED)
    networks = init(jax.random.key(0), scenario.config)

    def play(keys: jax.Array) -> Played:
        reset_keys, play_keys = jax.vmap(jax.random.split, out_axes=1)(keys)
        naive = scenario.policy("naive")
        states = jax.vmap(lambda key: mission.reset(key, scenario, networks, naive))(reset_keys)

        def step(states: MissionState, keys: jax.Array):
            after, _ = mission_step(keys, scenario, networks, states)
            # The ramp towards the command at the period's end is that towards the wanted one.
            return after, (states, after.robots.command)

        def skip(states: MissionState, keys: jax.Array):
            return step(states, keys)[0], None

        number = PERIODS_BEFORE + periods
        step_keys = jax.vmap(lambda key: jax.random.split(key, number), out_axes=1)(play_keys)
        states, _ = jax.lax.scan(skip, states, step_keys[:PERIODS_BEFORE])
        played = jax.lax.scan(step, states, step_keys[PERIODS_BEFORE:])[1]
        return jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), played)

    fast_to_compile = {"xla_backend_optimization_level": 0}
    record = jax.jit(play, compiler_options=fast_to_compile)
    played = record(jax.random.split(jax.random.key(1), min(batch, _MOST_PLAYED)))
    rows = jnp.arange(batch) % min(batch, _MOST_PLAYED)
    return scenario, jax.tree.map(lambda x: x[rows], played)


def _as_drives(played: Played) -> Drives:
    """`[B * P]` drives, each of one control period, with the commands that `move` gives."""
    substeps = round(CONTROL_PERIOD / arenas.TIMESTEP)
    flat, wanted = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), played)

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
        wheel_speeds=jax.jit(jax.vmap(ramp))(flat.robots.command, wanted),
    )


def _drive_side(arena: Arena, drives: Drives, workers: Workers, keeps_data: bool = False) -> Side:
    """Our physics, `arena.drive`; between two steps it keeps the whole data of MJX or the state."""

    def drive(drives: Drives) -> tuple[jax.Array, jax.Array]:
        is_empty = not np.any(arena.poi_of_geom >= 0)
        still = arena.data if is_empty else arenas.put(arena, drives.layout, drives.poses)

        def kept(data: mjx.Data) -> PyTree:
            return data if keeps_data else (data.qpos, data.qvel, data.qacc_warmstart)

        def step(state: PyTree, wheel_speeds: jax.Array) -> tuple[PyTree, None]:
            names = ("qpos", "qvel", "qacc_warmstart")
            data = state if keeps_data else still.replace(**dict(zip(names, state, strict=True)))
            return kept(arenas.drive(arena, data, wheel_speeds)), None

        start = still.replace(
            qpos=drives.poses.reshape(-1),
            qvel=drives.velocity.reshape(-1),
            qacc_warmstart=drives.warmstart,
        )
        end = jax.lax.scan(step, kept(start), drives.wheel_speeds)[0]
        return (end.qpos, end.qvel) if keeps_data else end[:2]

    batch, steps = drives.wheel_speeds.shape[:2]
    return measure.compiled(
        jax.vmap(drive), drives, work=batch * steps, batch=batch, workers=workers
    )


def _move_side(scenario: Mission, played: Played) -> Side:
    """Our physics as the mission calls it, one period after the other, on all devices."""

    def periods(played: Played) -> tuple[jax.Array, jax.Array]:
        by_period = jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), played)
        moved = jax.lax.map(lambda period: move(scenario, *period), by_period)
        poses, velocity = moved.scene.poses, moved.velocity
        return tuple(jnp.swapaxes(x, 0, 1) for x in (poses, velocity))  # pyright: ignore

    batch, number = played[0].steps.shape
    substeps = round(CONTROL_PERIOD / arenas.TIMESTEP)
    work = batch * number * substeps
    workers = devices.start(None)
    return measure.compiled(periods, played, work=work, batch=batch, workers=workers)


def _native_sides(
    simulate: Callable[..., Callable[[], PyTree]], arena: Arena, drives: Drives
) -> list[Side]:
    """C MuJoCo on the same drives, with a thread for each core and twice as many."""
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
    cores = devices.cores()
    return [
        Side(simulate(arena.mj_model, inputs, threads), batch * steps, batch)
        for threads in (cores, 2 * cores)
    ]


def _check(ours: Side, theirs: Side, tolerance: float, share: float) -> None:
    """Raises a `RuntimeError` if fewer than `share` of the last poses agree."""
    # Ours come in parts, one of each thread; so do a peer's in JAX.
    poses, others = (
        np.asarray(found[0]).reshape(-1, 3)
        for found in (
            measure.joined(found) if isinstance(found, list) else found
            for found in (ours.run(), theirs.run())
        )
    )
    worst = float(np.quantile(np.abs(poses - others).max(axis=-1), share))
    if not worst <= tolerance:
        raise RuntimeError(f"physics differs from the peer's by {worst} m or rad")
