"""Rays of whole LiDAR scans and camera scanlines, against C MuJoCo's `mj_multiRay`."""

import os

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from benchmarks import measure
from benchmarks.measure import Options, Row, Side
from benchmarks.peers import native
from jaxsense import PRESETS
from jaxsense.run import devices
from jaxsense.sim import arena as arenas
from jaxsense.sim import raycast
from jaxsense.sim import world as worlds
from jaxsense.sim.raycast import Hit
from jaxsense.sim.world import World

_TOLERANCE = 1e-4  # m
_GRAZING = 1e-3  # share of rays that pass an edge so closely that rounding decides what they meet


def rays(options: Options) -> Row:
    """Distance, geom and normal of every ray of both robots' sensors, in random scenes."""
    world = worlds.make_world(PRESETS["default"])
    batches = measure.batches(options, quick=8, cpu=(64, 256, 1024), accelerator=(16384, 65536))
    placed = _random_scenes(jax.random.key(0), world, batches[-1])
    num_rays = sum(len(sensor.angles) for sensor in world.sensors)
    workers = devices.start(None)
    cast = jax.vmap(lambda data: _cast(world, data))

    def our_side(batch: int) -> Side:
        some = jax.tree.map(lambda x: x[:batch], placed)
        return measure.compiled(cast, some, work=batch * num_rays, batch=batch, workers=workers)

    ours = [our_side(batch) for batch in batches]
    theirs = _native_sides(world, placed) if options.peers else []
    if theirs:
        _check(devices.joined(ours[-1].run()), theirs[0].run())
    name = "mujoco.mj_multiRay"
    return measure.compare("rays", "rays/s", ours, theirs, options, peer=name, packages=("mujoco",))


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
        section = raycast.cross_section(world.arena, data, sensor.height, robot)
        x_part, y_part = jnp.asarray(sensor.directions)
        in_world = raycast.turned((x_part, y_part), yaw)
        return raycast.cast_along(section, jnp.stack([x, y]), in_world)

    return tuple(scan(robot) for robot in range(len(world.sensors)))


def _native_sides(world: World, placed: mjx.Data) -> list[Side]:
    """C MuJoCo in the same scenes, with one thread and with one for each core."""
    model = world.arena.mj_model
    scans = []
    for mocap_pos, mocap_quat, qpos in zip(
        np.asarray(placed.mocap_pos),
        np.asarray(placed.mocap_quat),
        np.asarray(placed.qpos),
        strict=True,
    ):
        data = mujoco.MjData(model)  # pyright: ignore[reportAttributeAccessIssue]
        data.mocap_pos[:], data.mocap_quat[:], data.qpos[:] = mocap_pos, mocap_quat, qpos
        mujoco.mj_kinematics(model, data)  # pyright: ignore[reportAttributeAccessIssue]
        for robot, sensor in enumerate(world.sensors):
            x, y, yaw = qpos.reshape(-1, 3)[robot].astype(np.float64)
            angles = yaw + sensor.angles
            directions = np.stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)], axis=-1)
            origin = np.array([x, y, sensor.height])
            scans.append(native.Scan(data, origin, directions, model.body(f"robot{robot}").id))
    number = sum(len(scan.directions) for scan in scans)
    return [
        Side(native.cast(model, scans, threads), number, len(scans))
        for threads in sorted({1, os.cpu_count() or 1})
    ]


def _check(ours: tuple[Hit, ...], theirs: list[tuple[np.ndarray, np.ndarray]]) -> None:
    """Raises a `RuntimeError` if distances or geoms differ."""
    robots = len(ours)
    for robot, hits in enumerate(ours):
        distance = np.stack([distance for distance, _ in theirs[robot::robots]])
        geom = np.stack([geom for _, geom in theirs[robot::robots]])
        is_close = np.abs(np.asarray(hits.distance) - distance) <= _TOLERANCE
        is_right = (is_close & (np.asarray(hits.geom) == geom)).mean()
        if is_right < 1 - _GRAZING:
            raise RuntimeError(f"only {is_right:.5f} of the rays agree with C MuJoCo's")
