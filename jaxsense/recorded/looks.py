"""Looks of real sensors: read from one file, and compared with simulated ones."""

import dataclasses
import itertools
from collections.abc import Mapping
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxsense.config import Config
from jaxsense.core import checks
from jaxsense.core.types import Key
from jaxsense.recorded import resampling
from jaxsense.sim import arena as arenas
from jaxsense.sim import sensors, viewpoints, windows
from jaxsense.sim import world as worlds
from jaxsense.sim.light import random_light
from jaxsense.sim.sensors import Sensor
from jaxsense.sim.world import Scene, World

NUM_SIMULATED = 96
"""Simulated windows to find the nearest of."""
_ROOM = 0.5  # m, behind a PoI
_MAX_SIDE = 100.0  # m


@dataclasses.dataclass(frozen=True)
class RecordedLooks:
    """Looks at C PoIs by some or all sensors of a run.

    Attributes:
      positions: of the PoIs, in metres.
      poses: for each sensor from where it looked: x [m], y [m] and yaw [rad].
      scans: for each sensor readings of its rays, NaN where none was recorded.
    """

    positions: Float[np.ndarray, "C 2"]
    poses: Mapping[str, Float[np.ndarray, "C 3"]]
    scans: Mapping[str, Float[np.ndarray, "C B *channels"]]

    def seen_from(self, name: str) -> tuple[Float[np.ndarray, " C"], Float[np.ndarray, " C"]]:
        """Bearing, in radians, and distance, in metres, of each PoI from the sensor `name`."""
        x, y = (self.positions - self.poses[name][:, :2]).T
        bearing = resampling.within_a_turn(np.arctan2(y, x) - self.poses[name][:, 2])
        return bearing.astype(np.float32), np.hypot(x, y).astype(np.float32)


@checks.typed
def read(config: Config, file: Path | str) -> RecordedLooks:
    """Reads a recording, a file of NumPy's format `.npz`.

    For C PoIs it holds:

        places       [C, 2]       their positions, in metres
        NAME_poses   [C, 3]       from where the sensor NAME looked: x, y in metres, yaw in radians
        NAME_scans   [C, A, ...]  what all its A rays read: metres, or linear RGB from 0 to 1
        NAME_angles  [A]          their directions in radians, if they are not those of the run

    A distance is infinite or 0 for a ray without a return, and any reading NaN for a ray that was
    not recorded. Short gaps between rays with a return are closed, see `resampling.close_gaps`. A
    sensor may be missing, but not all. Scans along other rays are resampled, see `resample`.

    Raises:
      OSError: if the file cannot be read.
      ValueError: if it lacks something or has another shape, if a reading is negative, or if its
        rays do not suffice.
    """
    try:
        with np.load(file, allow_pickle=False) as content:
            found = dict(content)
    except OSError:
        raise
    except Exception:  # whatever the content makes zipfile, zlib and NumPy raise
        expected = "is not a whole file of NumPy's format .npz, or holds objects, not numbers"
        raise ValueError(f"{file} {expected}") from None
    of_sensors = {sensor.name: sensor for sensor in sensors.make(config)}
    for name in found:
        sensor, _, part = name.rpartition("_")
        if part in ("poses", "scans", "angles") and sensor not in of_sensors:
            expected = f"must be {' or '.join(of_sensors)}"
            raise ValueError(f"{name} is of an unknown sensor; {expected}")
    some = [n for n in of_sensors if {f"{n}_poses", f"{n}_scans"} & {*found}] or [*of_sensors]
    places = _array(found, "places", (np.size(found.get("places", ())) // 2, 2))
    poses = {name: _array(found, f"{name}_poses", (len(places), 3)) for name in some}
    scans = {name: _scans(found, of_sensors[name], len(places)) for name in some}
    return RecordedLooks(places, poses, scans)


def _scans(found: Mapping[str, np.ndarray], sensor: Sensor, number: int) -> np.ndarray:
    """Checked scans of one sensor, along its own rays and without the gaps of lost beams."""
    name, rays = f"{sensor.name}_scans", sensor.angles
    other = f"{sensor.name}_angles"
    if is_other := other in found:
        rays = _array(found, other, (found[other].size,))
        resampling.require_angles(f"angles of {sensor.name}", rays)
    advice = "" if is_other else f"; of other rays, {other} must hold the angles, in radians"
    scans = _array(found, name, (number, len(rays), *sensor.shape[1:]), advice)
    if sensor.channels == 3 and scans.dtype.kind in "iu":
        expected = "linear RGB from 0 to 1: divide bytes by 255 and undo their gamma"
        raise ValueError(f"{name} holds whole numbers ({scans.dtype}); must be {expected}")
    wrong = scans[~(np.asarray(sensor.is_valid(jnp.asarray(scans))) | np.isnan(scans))]
    if wrong.size:
        returns = ", infinite or 0 without a return" if sensor.measures_distance else ""
        most = " and at most 1, linear RGB" if sensor.channels == 3 else ""
        raise ValueError(f"{name} holds {wrong[0]:g}; must be at least 0{returns}{most}")
    if sensor.measures_distance:
        closed = [resampling.close_gaps(rays, scan, step=sensor.steps[1]) for scan in scans]
        scans = np.where(np.isnan(scans), np.float32(np.nan), np.reshape(closed, scans.shape))
    return resample(sensor, rays, scans) if is_other else scans


def _array(
    found: Mapping[str, np.ndarray], name: str, shape: tuple[int, ...], advice: str = ""
) -> np.ndarray:
    """An array of a recording, which holds numbers in this shape."""
    if name not in found:
        raise ValueError(f"{name} is missing; a recording holds places, NAME_poses and NAME_scans")
    array = found[name]
    if array.dtype.kind not in "fiu":
        raise ValueError(f"{name} must hold numbers, not {array.dtype}")
    if array.shape != shape:
        raise ValueError(f"{name} has the shape {array.shape}; must be {shape}{advice}")
    return array


def resample(
    sensor: Sensor,
    angles: Float[np.ndarray, " A"],
    readings: Float[np.ndarray, "S A *channels"],
) -> Float[np.ndarray, "S B *channels"]:
    """Resamples recorded scans to the rays of a simulated sensor, see `resampling.resample`.

    Args:
      angles: directions of the recorded rays in the robot's frame, in radians, in any order.
      readings: recorded scans, in the units of the sensor.

    Returns:
      Readings, NaN outside the recorded field of view: `Models.detect` then says that nothing is
      known.

    Raises:
      ValueError: if the recorded rays are too few or too far apart.
    """
    most = resampling.MAX_STEPS * np.degrees(sensor.steps[1])
    between = np.degrees(resampling.median_step(angles))
    if between > most:
        found = f"step between the rays of {sensor.name} = {between:.2f} degrees"
        raise ValueError(f"{found}: must be at most {most:.2f} degrees")
    needed = (sensor.window - 1) * sensor.stride + 1
    covered = resampling.covered(sensor.angles, angles, sensor.steps[1])
    runs = (sum(1 for _ in run) for is_covered, run in itertools.groupby(covered) if is_covered)
    number = max(runs, default=0)
    if number < needed:
        expected = f"must be at least {needed}, as wide as the window of its detector"
        raise ValueError(f"{number} rays of {sensor.name} were recorded: {expected}")
    found = resampling.resample(
        sensor.angles,
        angles,
        np.moveaxis(readings, 1, 0),
        measures_distance=sensor.measures_distance,
        step=sensor.steps[1],
    )
    return np.moveaxis(found, 0, 1)


@dataclasses.dataclass(frozen=True)
class Compared:
    """Recorded windows of one sensor, and for each the nearest simulated one.

    Residuals are in the unit of the readings, NaN on rays that hit no PoI.

    Attributes:
      recorded: inputs of the detector, of looks whose window was recorded completely.
      simulated: the nearest simulated ones.
      residuals: recorded minus simulated.
      usual: residuals of other simulated windows in place of the recorded ones.
    """

    recorded: Float[np.ndarray, "L F"]
    simulated: Float[np.ndarray, "L F"]
    residuals: Float[np.ndarray, "L F"]
    usual: Float[np.ndarray, "L F"]

    def __str__(self) -> str:
        """How far apart they are: medians of root mean squares over the rays at the PoI."""
        recorded, usual = (np.median(root_mean_square(x)) for x in (self.residuals, self.usual))
        return (
            f"{len(self.recorded)} recorded windows are {recorded:.4f} from the nearest of "
            f"{NUM_SIMULATED} simulated ones, with a median residual of "
            f"{np.nanmedian(self.residuals):+.4f}; simulated ones are {usual:.4f} away"
        )


@checks.typed
def compare(config: Config, looks: RecordedLooks) -> dict[str, Compared]:
    """Compares recorded looks with simulated ones at the same bearing and distance.

    Returns:
      What was found of each recorded sensor; print it.

    Raises:
      ValueError: if no window of a sensor was recorded completely.
    """
    return {name: _compared(config, config.modalities.index(name), looks) for name in looks.scans}


def _compared(config: Config, modality: int, looks: RecordedLooks) -> Compared:
    name = config.modalities[modality]
    bearings, distances = looks.seen_from(name)
    world = make_world(config, float(np.max(distances, initial=0.0)))
    sensor = world.sensors[modality]
    cut = jax.vmap(lambda *look: windows.as_window(sensor, windows.around(sensor, *look)))
    found = np.asarray(cut(looks.scans[name], bearings))
    is_whole = (bearings >= sensor.angles.min()) & (bearings <= sensor.angles.max())
    is_whole &= np.isfinite(found).all(axis=1)
    if not is_whole.any():
        raise ValueError(f"{name}_scans: no window around a PoI was recorded completely")
    whole = [x[is_whole] for x in (found, bearings, distances)]
    keys = jax.random.split(jax.random.key(0), len(whole[0]))
    of_each = jax.jit(jax.lax.map, static_argnums=0)
    compared = of_each(lambda look: nearest(look[0], world, modality, *look[1:]), (keys, *whole))
    return Compared(whole[0], *map(np.asarray, compared))


def root_mean_square(residuals: Float[Array | np.ndarray, "*S F"]) -> Float[Array, "*S"]:
    """Root mean square of the residuals of each window, without NaN."""
    return jnp.sqrt(jnp.nanmean(residuals**2, axis=-1))


def make_world(config: Config, distance: float) -> World:
    """Makes a simulation whose walls lie beyond a PoI at `distance`, in metres, from the middle."""
    side = min(2 * (distance + config.arena.poi_extent + _ROOM), _MAX_SIDE)
    arena = dataclasses.replace(config.arena, side=max(config.arena.side, side))
    return worlds.make_world(dataclasses.replace(config, arena=arena))


def simulate(
    key: Key,
    world: World,
    modality: int,
    poi_class: Int[Array, ""],
    bearing: Float[Array, ""],
    distance: Float[Array, ""],
) -> Float[Array, "F"]:
    """Simulates a window like a recorded one: of a lone PoI, seen from the middle of the arena.

    Args:
      key: random key of light, yaw, error of the bearing and noise.
      bearing: believed bearing of the PoI, in radians.
      distance: distance of its centre, in metres; less than to the walls.
    """
    layout_key, light_key, error_key, noise_key = jax.random.split(key, 4)
    config, limit = world.arena.config, jnp.radians(world.viewpoint.bearing_error)
    layout = arenas.random_layout(layout_key, config, jnp.full(config.num_pois, poi_class))
    away = jnp.array(viewpoints.outside(config))
    true = bearing - jax.random.uniform(error_key, minval=-limit, maxval=limit)
    centre = distance * jnp.stack([jnp.cos(true), jnp.sin(true)])
    positions = jnp.tile(away, (config.num_pois, 1)).at[0].set(centre)
    poses = jnp.zeros((len(world.sensors), 3)).at[:, :2].set(away).at[modality, :2].set(0.0)
    layout = dataclasses.replace(layout, position=positions)
    scene = Scene(layout, random_light(light_key, world.reads_conditions), poses)
    return worlds.window_around(noise_key, world, scene, modality, bearing)


def nearest(
    key: Key,
    world: World,
    modality: int,
    window: Float[Array, " F"],
    bearing: Float[Array, ""],
    distance: Float[Array, ""],
) -> tuple[Float[Array, " F"], Float[Array, " F"], Float[Array, " F"]]:
    """Finds the nearest of many simulated windows of a lone PoI of any class, light and yaw.

    Only rays that hit a PoI of any shape count, so the background does not matter. The other
    arguments are those of `simulate`.

    Returns:
      The window and its residuals, and the usual ones, see `Compared`.
    """
    sensor, arena = world.sensors[modality], world.arena.config
    classes = jnp.arange(NUM_SIMULATED + 1) % len(arena.classes)
    simulated = jax.vmap(lambda *x: simulate(x[0], world, modality, x[1], bearing, distance))
    other, *_ = many = simulated(jax.random.split(key, NUM_SIMULATED + 1), classes)
    # The rays that hit a PoI of any shape, wherever within the error of its bearing it is.
    half_width = jnp.arcsin(jnp.minimum(arena.poi_half_width / distance, 1.0))
    off = jnp.abs(windows.around(sensor, sensor.angles, bearing) - bearing)
    limit = jnp.maximum(half_width - jnp.radians(world.viewpoint.bearing_error), off.min())
    is_at_poi = jnp.repeat(off <= limit, sensor.channels)

    def nearest_to(one: jax.Array) -> tuple[jax.Array, jax.Array]:
        residuals = jnp.where(is_at_poi[None], one[None] - many[1:], jnp.nan)
        chosen = jnp.argmin(root_mean_square(residuals))
        return many[1 + chosen], residuals[chosen]

    (found, residuals), (_, usual) = nearest_to(window), nearest_to(other)
    return found, residuals, usual
