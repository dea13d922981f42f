"""Rays of whole LiDAR scans and camera scanlines, against those of C MuJoCo and of Warp."""

import dataclasses
import functools
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import PyTree
from mujoco import mjx

from benchmarks import measure, peers
from benchmarks.measure import Options, Row, Side
from benchmarks.peers import native
from jaxsense import PRESETS
from jaxsense.run import devices
from jaxsense.run.devices import Workers
from jaxsense.sim import arena as arenas
from jaxsense.sim import raycast
from jaxsense.sim import world as worlds
from jaxsense.sim.raycast import CrossSection, Hit
from jaxsense.sim.world import World

_TOLERANCE = 1e-4  # m
_GRAZING = 1e-3  # share of rays that pass an edge so closely that rounding decides what they meet


def rays(options: Options) -> Row:
    """Distance, geom and normal of every ray of both robots' sensors, in random scenes."""
    world, scenes, ours = _our_sides(options, devices.start(None))
    theirs = _native_sides(world, scenes[-1]) if options.peers else []
    if theirs:
        found, robots = theirs[0].run(), len(world.sensors)
        by_robot = [zip(*found[robot::robots], strict=True) for robot in range(robots)]
        _check(ours[-1], [tuple(map(np.stack, parts)) for parts in by_robot])
    return _compare("rays", world, ours, theirs, options, "mujoco.mj_multiRay", ("mujoco",))


def rays_warp(options: Options, row: str = "rays_warp", has_tree: bool = False) -> Row:
    """The same rays on one device against MuJoCo Warp's, which try all geoms."""
    world, scenes, ours = _our_sides(options, devices.start(1))
    warp, theirs = peers.load("mujoco_warp", options.peers), []
    if warp is not None:
        cast = functools.partial(warp.cast, has_tree=has_tree)
        theirs = [_warp_side(cast, world, some) for some in scenes]
        ends = np.cumsum([len(sensor.angles) for sensor in world.sensors])[:-1]
        found = (np.split(each.numpy(), ends, axis=1) for each in theirs[0].run())
        _check(ours[0], list(zip(*found, strict=True)))
    tree = " with a BVH" if has_tree else ""
    packages = ("mujoco-mjx", "warp-lang")
    return _compare(row, world, ours, theirs, options, f"mujoco_warp.rays{tree}", packages)


def rays_warp_bvh(options: Options) -> Row:
    """The same, where they fit a tree of bounding volumes to the scenes and search it."""
    return rays_warp(options, "rays_warp_bvh", has_tree=True)


def _our_sides(options: Options, workers: Workers) -> tuple[World, list[mjx.Data], list[Side]]:
    """The world, scenes for each size of a batch, and our rays in them."""
    world = worlds.make_world(PRESETS["default"])
    batches = measure.batches(options, quick=8, cpu=(64, 256, 1024), accelerator=(16384, 65536))
    placed = _random_scenes(jax.random.key(0), world, batches[-1])
    scenes = [jax.tree.map(lambda x: x[:batch], placed) for batch in batches]  # noqa: B023
    cast = jax.vmap(lambda data: _cast(world, data))
    ours = [
        measure.compiled(cast, some, work=batch * _num_rays(world), batch=batch, workers=workers)
        for batch, some in zip(batches, scenes, strict=True)
    ]
    return world, scenes, ours


def _num_rays(world: World) -> int:
    """Rays of a scene."""
    return sum(len(sensor.angles) for sensor in world.sensors)


def _compare(
    row: str,
    world: World,
    ours: Sequence[Side],
    theirs: Sequence[Side],
    options: Options,
    peer: str,
    packages: tuple[str, ...],
) -> Row:
    """The row, which also states how many pairs of a ray and a geom our sensors test."""
    measured = measure.compare(row, "rays/s", ours, theirs, options, peer=peer, packages=packages)
    tests = sum(
        len(sensor.angles) * len(_section(world, world.arena.data, robot).geom)
        for robot, sensor in enumerate(world.sensors)
    )
    also = {"ray-geom tests/s": measured.ours * tests / _num_rays(world)}
    return dataclasses.replace(measured, also=also)


def _random_scenes(key: jax.Array, world: World, batch: int) -> mjx.Data:
    """`[B]` MJX states after kinematics, each robot at a viewpoint of a PoI."""
    config = world.arena.config
    class_key, scene_key = jax.random.split(key)
    classes = jax.random.randint(class_key, (batch, config.num_pois), 0, len(config.classes))

    def place(key: jax.Array, classes: jax.Array) -> mjx.Data:
        scene = worlds.random_scene(key, world, classes)
        return arenas.place(world.arena, scene.layout, scene.poses)

    return jax.jit(jax.vmap(place))(jax.random.split(scene_key, batch), classes)


def _cast(world: World, data: mjx.Data) -> tuple[Hit, ...]:
    """What the rays of each robot's sensor meet in one scene."""

    def scan(robot: int) -> Hit:
        sensor = world.sensors[robot]
        x, y, yaw = arenas.robot_poses(data)[robot]
        section = _section(world, data, robot)
        x_part, y_part = jnp.asarray(sensor.directions)
        in_world = raycast.turned((x_part, y_part), yaw)
        return raycast.cast_along(section, jnp.stack([x, y]), in_world)

    return tuple(scan(robot) for robot in range(len(world.sensors)))


def _section(world: World, data: mjx.Data, robot: int) -> CrossSection:
    """What a robot's sensor may see."""
    return raycast.cross_section(world.arena, data, world.sensors[robot].height, robot)


def _rays_of(world: World, placed: mjx.Data, robot: int) -> tuple[np.ndarray, np.ndarray]:
    """Origins `[B, 3]` and directions `[B, rays, 3]` of a robot's rays."""
    sensor = world.sensors[robot]
    poses = np.asarray(placed.qpos, np.float64).reshape(len(placed.qpos), -1, 3)
    x, y, yaw = poses[:, robot].T
    angles = yaw[:, None] + sensor.angles
    origins = np.stack([x, y, np.full_like(x, sensor.height)], axis=-1)
    return origins, np.stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)], axis=-1)


def _body_of(world: World, robot: int) -> int:
    return world.arena.mj_model.body(f"robot{robot}").id


def _native_sides(world: World, placed: mjx.Data) -> list[Side]:
    """C MuJoCo in the same scenes, with one thread and with one for each core."""
    model, robots = world.arena.mj_model, range(len(world.sensors))
    rays = [_rays_of(world, placed, robot) for robot in robots]
    scans = []
    for scene, (mocap_pos, mocap_quat, qpos) in enumerate(
        zip(
            np.asarray(placed.mocap_pos),
            np.asarray(placed.mocap_quat),
            np.asarray(placed.qpos),
            strict=True,
        )
    ):
        data = mujoco.MjData(model)  # pyright: ignore[reportAttributeAccessIssue]
        data.mocap_pos[:], data.mocap_quat[:], data.qpos[:] = mocap_pos, mocap_quat, qpos
        mujoco.mj_kinematics(model, data)  # pyright: ignore[reportAttributeAccessIssue]
        for robot in robots:
            origin, directions = (part[scene] for part in rays[robot])
            scans.append(native.Scan(data, origin, directions, _body_of(world, robot)))
    number = sum(len(scan.directions) for scan in scans)

    return [
        Side(native.cast(model, scans, threads), number, len(scans))
        for threads in sorted({1, devices.cores()})
    ]


def _warp_side(cast: Callable[..., Callable[[], PyTree]], world: World, placed: mjx.Data) -> Side:
    """Warp in the same scenes, with the rays of all robots in one call."""
    robots = range(len(world.sensors))
    origins, directions = [], []
    for robot in robots:
        origin, direction = _rays_of(world, placed, robot)
        origins.append(np.broadcast_to(origin[:, None], direction.shape))
        directions.append(direction)
    bodies = [_body_of(world, robot) for robot in robots]
    run = cast(
        world.arena.mj_model,
        geom_xpos=np.asarray(placed.geom_xpos),
        geom_xmat=np.asarray(placed.geom_xmat),
        origins=np.concatenate(origins, axis=1),
        directions=np.concatenate(directions, axis=1),
        robot_bodies=np.repeat(bodies, [len(sensor.angles) for sensor in world.sensors]),
    )
    batch = len(placed.qpos)
    return Side(run, batch * _num_rays(world), batch)


def _check(ours: Side, theirs: Sequence[tuple[np.ndarray, ...]]) -> None:
    """Raises a `RuntimeError` if `[B, rays]` distances or geoms of a robot differ."""
    for hits, (distance, geom) in zip(measure.joined(ours.run()), theirs, strict=True):
        is_close = np.abs(np.asarray(hits.distance) - distance) <= _TOLERANCE
        is_right = (is_close & (np.asarray(hits.geom) == geom)).mean()
        if is_right < 1 - _GRAZING:
            raise RuntimeError(f"only {is_right:.5f} of the rays agree with the peer's")
