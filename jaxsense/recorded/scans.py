"""Scans of real sensors: looks at PoIs, read from a file, and the noise of a LiDAR."""

import dataclasses
import itertools
from collections.abc import Mapping
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import scipy.special
from jaxtyping import Float

from jaxsense.config import Config, LidarConfig
from jaxsense.core import checks
from jaxsense.recorded import resampling
from jaxsense.sim import sensors
from jaxsense.sim.sensors import Sensor

_BEAMS = 15  # of a piece of wall
_MIN_FACING = 0.5  # cosine of the angle at which a beam meets a wall
_MIN_PIECES = 20  # in a bin of distances
_EDGE = 0.5  # m between the surfaces of an edge
_MARGIN = 0.15  # m between a mixed pixel and both surfaces


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
    step, most = sensor.steps[1], resampling.MAX_STEPS * np.degrees(sensor.steps[1])
    needed = (sensor.window - 1) * sensor.stride + 1
    covered = resampling.covered(sensor.angles, angles, step)
    runs = (sum(1 for _ in run) for is_covered, run in itertools.groupby(covered) if is_covered)
    number = max(runs, default=0)
    if number < needed:
        raise ValueError(
            f"{number} neighbouring rays of {sensor.name} were recorded: must be at least "
            f"{needed}, the window of its detector, from rays at most {most:.2f} degrees apart"
        )
    rows, is_distance = np.moveaxis(readings, 1, 0), sensor.measures_distance
    found = resampling.resample(
        sensor.angles, angles, rows, measures_distance=is_distance, step=step
    )
    return np.moveaxis(found, 0, 1)


def fit_noise(
    config: LidarConfig, angles: Float[np.ndarray, " A"], ranges: Float[np.ndarray, "S A"]
) -> LidarConfig:
    """Fits the noise settings of a LiDAR to recorded scans.

    `range_noise` and `range_noise_growth` are a line through the medians, in bins of distance, of
    the standard deviations of pieces of walls: curved or rough ones are few enough not to matter.
    `mixed_pixels` is the share of edges at which a beam measures a distance between both
    surfaces; thin objects count as such. `dropout` is the share of beams without a return between
    two of one surface.

    Args:
      config: other settings of the scanner.
      angles: directions of the beams, in radians, in order.
      ranges: distances in metres, infinite or 0 without a return.

    Raises:
      ValueError: if the scans show too few straight walls or edges.
    """
    checks.require_type("config", config, LidarConfig, "as config.lidar")
    ranges = _distances(angles, ranges)
    residuals, distances = _wall_residuals(angles, ranges)
    free = _BEAMS - 2  # a line has two parameters
    unbiased = np.sqrt(scipy.special.chdtri(free, 0.5) / free)
    spread = np.sqrt(np.sum(residuals**2, axis=1) / free) / unbiased
    bins = np.where(distances < config.max_range, np.floor(2 * distances), -1)
    kept, number = np.unique(bins[bins >= 0], return_counts=True)
    kept, number = kept[number >= _MIN_PIECES], number[number >= _MIN_PIECES]
    if len(kept) < 2:
        raise ValueError(
            f"scans show {len(distances)} pieces of walls, {_MIN_PIECES} or more of them in "
            f"{len(kept)} bins of half a metre: must be in 2 or more bins (in metres, radians?)"
        )
    middles, medians = ([np.median(x[bins == i]) for i in kept] for x in (distances, spread))
    growth, noise = np.polyfit(middles, medians, 1, w=np.sqrt(number))
    mixed, dropout = _edges(ranges, config.max_range)
    found = {"range_noise": noise, "range_noise_growth": growth, "mixed_pixels": mixed}
    rounded = {name: round(max(float(x), 0.0), 5) for name, x in found.items()}
    return dataclasses.replace(config, **rounded, dropout=round(dropout, 5))


def _distances(angles: np.ndarray, ranges: np.ndarray) -> Float[np.ndarray, "S A"]:
    """Checked distances, infinite without a return."""
    if len(angles) < _BEAMS:
        raise ValueError(f"number of angles = {len(angles)}: must be at least {_BEAMS}")
    found = resampling.with_returns(ranges)
    checks.require_shape("ranges", found, (None, len(angles)))
    expected = "must be 0 or infinite without a return"
    checks.require("ranges", found, lambda x: ~(np.isfinite(x) & (x < 0)), expected)
    return np.where(np.isnan(found), np.float32(np.inf), found)


def _wall_residuals(
    angles: Float[np.ndarray, " A"], ranges: Float[np.ndarray, "S A"]
) -> tuple[Float[np.ndarray, "R K"], Float[np.ndarray, " R"]]:
    """Residuals of K neighbouring beams from straight lines, and their mean distances, in metres.

    They are of all pieces of scans that no surface of another depth interrupts and that face the
    scanner.
    """
    residuals, distances = [], []
    for first in range(0, len(angles) - _BEAMS + 1, _BEAMS):
        piece = slice(first, first + _BEAMS)
        found = ranges[:, piece][np.isfinite(ranges[:, piece]).all(axis=1)]
        directions = np.stack([np.cos(angles[piece]), np.sin(angles[piece])], axis=-1)
        points = found[:, :, None] * directions[None]
        centre = points.mean(axis=1, keepdims=True)
        # The normal of the line with the least squared distances.
        normal = np.linalg.svd(points - centre, full_matrices=False)[2][:, 1]
        facing = normal @ directions.T
        to_wall = np.sum(normal[:, None] * centre, axis=-1)
        with np.errstate(divide="ignore"):
            residual = found - to_wall / facing
        is_wall = np.abs(facing).min(axis=1) > _MIN_FACING
        is_wall &= np.abs(residual).max(axis=1) < resampling.SURFACE
        residuals.append(residual[is_wall])
        distances.append(found[is_wall].mean(axis=1))
    return np.concatenate(residuals), np.concatenate(distances)


def _edges(ranges: Float[np.ndarray, "S A"], max_range: float) -> tuple[float, float]:
    """Share of edges with a mixed pixel, and of beams on one surface that drop out."""
    first, before, middle, after, last = (ranges[:, i : ranges.shape[1] - 4 + i] for i in range(5))
    with np.errstate(divide="ignore", invalid="ignore"):
        is_smooth = np.abs(first - before) < resampling.SURFACE
        is_smooth &= np.abs(after - last) < resampling.SURFACE
        near, far = np.minimum(before, after), np.maximum(before, after)
        is_edge = is_smooth & (far - near > _EDGE) & (far < max_range) & np.isfinite(middle)
        is_mixed = is_edge & (middle > near + _MARGIN) & (middle < far - _MARGIN)
        is_surface = is_smooth & (far - near < resampling.SURFACE) & (far < max_range)
        # A mixed pixel lies anywhere between both surfaces; those near one are not seen.
        visible = 1 - 2 * _MARGIN / (far - near)
    if not is_edge.any():
        raise ValueError("scans show no edges: must show some to fit the noise")
    mixed = np.sum(1 / visible[is_mixed])
    # A clean edge is met twice, before and after its jump; one whose mixed pixel is not seen looks
    # the same.
    clean = np.sum(is_edge & ~is_mixed) / 2
    lost = np.sum(is_surface & np.isinf(middle)) / max(np.sum(is_surface), 1)
    return float(mixed / (np.sum(is_mixed) + clean)), float(lost)
