"""Recordings: looks of real sensors in one file, checked against the sensors of a run."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxsense.config import Config
from jaxsense.sim import recorded, resampling, sensors
from jaxsense.sim.sensors import Sensor


@dataclasses.dataclass(frozen=True)
class RecordedLooks:
    """Looks at C PoIs by some or all sensors of a run.

    Attributes:
      positions: `[C, 2]` of the PoIs, in metres.
      poses: for each sensor `[C, 3]` from where it looked: x [m], y [m] and yaw [rad].
      scans: for each sensor `[C, B, ...]` readings of its rays, NaN where none was recorded.
    """

    positions: Float[np.ndarray, "C 2"]
    poses: Mapping[str, Float[np.ndarray, "C 3"]]
    scans: Mapping[str, Float[np.ndarray, "C B *channels"]]

    def seen_from(self, name: str) -> tuple[Float[np.ndarray, " C"], Float[np.ndarray, " C"]]:
        """Bearing, in radians, and distance, in metres, of each PoI from a sensor.

        Args:
          name: of the sensor.
        """
        x, y = (self.positions - self.poses[name][:, :2]).T
        bearing = resampling.within_a_turn(np.arctan2(y, x) - self.poses[name][:, 2])
        return bearing.astype(np.float32), np.hypot(x, y).astype(np.float32)


def read(config: Config, file: Path | str) -> RecordedLooks:
    """Reads a recording, a file of NumPy's format `.npz`.

    For C PoIs it holds:

        places       [C, 2]       their positions, in metres
        NAME_poses   [C, 3]       from where the sensor NAME looked: x, y in metres, yaw in radians
        NAME_scans   [C, A, ...]  what all its A rays read: metres, or linear RGB from 0 to 1
        NAME_angles  [A]          their directions in radians, if they are not those of the run

    A distance is infinite or 0 for a ray without a return, and any reading NaN for a ray that was
    not recorded. Short gaps between rays with a return are closed, see `resampling.close_gaps`. A
    sensor may be missing, but not all. Scans along other rays are resampled, see
    `sim.recorded.resample`.

    Args:
      config: settings of the run.
      file: the recording.

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
    made = sensors.make(config)
    parts = [f"{sensor.name}_{part}" for sensor in made for part in ("poses", "scans")]
    known = {"places", *parts, *(f"{sensor.name}_angles" for sensor in made)}
    for name in found:
        if name not in known and name.endswith(("_poses", "_scans", "_angles")):
            expected = f"must be {' or '.join(sensor.name for sensor in made)}"
            raise ValueError(f"{name} is of an unknown sensor; {expected}")
    some = [s for s in made if {f"{s.name}_poses", f"{s.name}_scans"} & {*found}] or made
    needed = [f"{sensor.name}_{part}" for sensor in some for part in ("poses", "scans")]
    for name in ("places", *needed):
        if name not in found:
            raise ValueError(f"{name} is missing; a recording holds places, {', '.join(parts)}")
    _require_shape(found, "places", ("C", 2))
    scans = {sensor.name: _scans(found, sensor) for sensor in some}
    poses = {sensor.name: found[f"{sensor.name}_poses"] for sensor in some}
    return RecordedLooks(found["places"], poses, scans)


def _scans(found: Mapping[str, np.ndarray], sensor: Sensor) -> np.ndarray:
    """Checks the looks of one sensor; returns its scans along the sensor's rays."""
    _require_shape(found, f"{sensor.name}_poses", ("C", 3))
    name, angles = f"{sensor.name}_scans", f"{sensor.name}_angles"
    if name in found and sensor.channels == 3 and found[name].dtype.kind in "iu":
        expected = "linear RGB from 0 to 1: divide bytes by 255 and undo their gamma"
        raise ValueError(f"{name} holds whole numbers ({found[name].dtype}); must be {expected}")
    rays, others = sensor.angles, f"; of other rays, {angles} must hold the angles, in radians"
    if angles in found:
        _require_shape(found, angles, ("A",))
        rays, others = found[angles], ""
        resampling.require_angles(f"angles of {sensor.name}", rays)
    _require_shape(found, name, ("C", len(rays), *sensor.shape[1:]), others)
    _require_valid(found[name], sensor)
    scans = _closed(sensor, rays, found[name])
    return recorded.resample(sensor, rays, scans) if angles in found else scans


def _closed(sensor: Sensor, angles: np.ndarray, scans: np.ndarray) -> np.ndarray:
    """Scans without the gaps of lost beams, as robots read them."""
    if not sensor.measures_distance:
        return scans
    closed = [resampling.close_gaps(angles, scan, step=sensor.steps[1]) for scan in scans]
    found = np.array(closed, np.float32).reshape(scans.shape)
    return np.where(np.isnan(scans), np.float32(np.nan), found)


def _require_valid(scans: np.ndarray, sensor: Sensor) -> None:
    """Raises `ValueError` if a reading is negative, or a brightness above 1."""
    is_valid = np.asarray(sensor.is_valid(jnp.asarray(scans, jnp.float32)))
    is_wrong = ~is_valid & ~np.isnan(scans)
    if is_wrong.any():
        returns = ", infinite or 0 without a return" if sensor.measures_distance else ""
        most = " and at most 1, linear RGB" if sensor.channels == 3 else ""
        found = f"{sensor.name}_scans holds {scans[is_wrong][0]:g}"
        raise ValueError(f"{found}; must be at least 0{returns or most}")


def _require_shape(
    found: Mapping[str, np.ndarray], name: str, shape: tuple[int | str, ...], others: str = ""
) -> None:
    """Raises `ValueError` unless an array holds numbers in a shape, for C places or A rays."""
    array = found[name]
    if array.dtype.kind not in "fiu":
        raise ValueError(f"{name} must hold numbers, not {array.dtype}")
    sizes: dict[int | str, int | None] = {
        "C": next(iter(found["places"].shape), None),
        "A": array.size,
    }
    if array.shape != tuple(sizes.get(size, size) for size in shape):
        text = f"({', '.join(map(str, shape))})".replace("(A)", "(A,)")
        of_places = " for C places" if "C" in shape else ""
        raise ValueError(f"{name} has the shape {array.shape}; must be {text}{of_places}{others}")
