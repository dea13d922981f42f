"""Looks of real sensors, read from one file."""

import dataclasses
import itertools
from collections.abc import Mapping
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxsense.config import Config
from jaxsense.core import checks
from jaxsense.recorded import resampling
from jaxsense.sim import sensors
from jaxsense.sim.sensors import Sensor


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
