"""Recorded scans: resampling, and fitting the noise of a LiDAR. All functions work on the host."""

import dataclasses

import numpy as np
import scipy.special
from jaxtyping import Bool, Float, Int

from jaxsense.config import LidarConfig
from jaxsense.core import checks
from jaxsense.sim import resampling
from jaxsense.sim.sensors import Sensor

_BEAMS = 15  # of a piece of wall
_MIN_FACING = 0.5  # cosine of the angle at which a beam meets a wall
_MIN_PIECES = 20  # in a bin of distances
_EDGE = 0.5  # m between the surfaces of an edge
_MARGIN = 0.15  # m between a mixed pixel and both surfaces


def resample(
    sensor: Sensor,
    angles: Float[np.ndarray, " A"],
    readings: Float[np.ndarray, "S A *channels"],
) -> Float[np.ndarray, "S B *channels"]:
    """Resamples recorded scans to the rays of a simulated sensor, see `resampling.resample`.

    Args:
      sensor: the sensor.
      angles: directions of the recorded rays in the robot's frame, in radians, in any order.
      readings: `[S, A, ...]` recorded scans, in the units of the sensor.

    Returns:
      `[S, B, ...]` readings, NaN outside the recorded field of view: `Models.detect` then says
      that nothing is there.

    Raises:
      ValueError: if an angle is no direction, the recorded rays are too few or too far apart, or no
        part of the sensor's field of view as wide as a window was recorded; it names what would
        fit.
    """
    angles = np.asarray(angles, np.float64)
    resampling.require_angles(f"angles of {sensor.name}", angles)
    if readings.shape[1:2] != angles.shape:
        expected = f"must be {readings.shape[1:2]}, one for each ray of the scans"
        raise ValueError(f"angles of {sensor.name} have the shape {angles.shape}: {expected}")
    (_, step), between = sensor.steps, resampling.median_step(angles)
    if between > resampling.MAX_STEPS * step:
        expected = f"must be at most {np.degrees(resampling.MAX_STEPS * step):.2f} degrees"
        found = f"step between the rays of {sensor.name} = {np.degrees(between):.2f} degrees"
        raise ValueError(f"{found}: {expected}")
    window = (sensor.window - 1) * sensor.stride + 1
    recorded = _longest(resampling.covered(sensor.angles, angles, step))
    if len(recorded) < window:
        needed, found = (
            np.degrees(np.ptp(angles)) if len(angles) else 0.0
            for angles in (sensor.angles[:window], sensor.angles[recorded])
        )
        expected = f"must be at least {needed:.1f}, as wide as the window of its detector"
        part = f"recorded part of the field of view of {sensor.name}"
        raise ValueError(f"{part} = {found:.1f} degrees: {expected}")
    found = resampling.resample(
        sensor.angles,
        angles,
        np.moveaxis(readings, 1, 0),
        measures_distance=sensor.measures_distance,
        step=step,
    )
    return np.moveaxis(found, 0, 1)


def _longest(is_recorded: Bool[np.ndarray, " B"]) -> Int[np.ndarray, " _"]:
    """Indices of the longest run of True."""
    ends = np.flatnonzero(np.diff(np.concatenate([[0], is_recorded, [0]]))).reshape(-1, 2)
    start, end = max(ends, key=np.ptp, default=(0, 0))
    return np.arange(start, end)


def _scans(angles: np.ndarray, ranges: np.ndarray) -> Float[np.ndarray, "S A"]:
    """Distances, infinite without a return; raises `ValueError` if they are none."""
    found = resampling.with_returns(ranges)
    if found.ndim != 2 or found.shape[1] != len(angles):
        expected = f"must be (S, {len(angles)}), one for each of the angles of each scan"
        raise ValueError(f"ranges have the shape {found.shape}: {expected}")
    wrong = found[(found < 0) & np.isfinite(found)]
    if wrong.size:
        raise ValueError(f"ranges = {wrong[0]:g}: must be 0 or infinite without a return")
    return np.where(np.isnan(found), np.float32(np.inf), found)


def wall_residuals(
    angles: Float[np.ndarray, " A"], ranges: Float[np.ndarray, "S A"]
) -> tuple[Float[np.ndarray, "R K"], Float[np.ndarray, " R"]]:
    """Computes how far measured distances lie from straight lines through K neighbouring beams.

    Args:
      angles: directions of the beams, in radians, in order.
      ranges: `[S, A]` distances in metres, infinite, NaN or 0 without a return.

    Returns:
      `[R, K]` residuals along the beams, in metres, of all pieces of scans that no surface of
      another depth interrupts and that face the scanner; and `[R]` their mean distances, in metres.

    Raises:
      ValueError: if there are fewer than K beams.
    """
    if len(angles) < _BEAMS:
        raise ValueError(f"number of angles = {len(angles)}: must be at least {_BEAMS}")
    ranges = _scans(angles, ranges)
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
      ranges: `[S, A]` distances in metres, infinite or 0 without a return.

    Raises:
      ValueError: if the scans show too few straight walls or edges.
    """
    checks.require_type("config", config, LidarConfig, "as config.lidar")
    residuals, distances = wall_residuals(angles, ranges)
    free = _BEAMS - 2  # a line has two parameters
    unbiased = np.sqrt(scipy.special.chdtri(free, 0.5) / free)
    spread = np.sqrt(np.sum(residuals**2, axis=1) / free) / unbiased
    bins = np.floor(2 * distances[distances < config.max_range]).astype(int)
    number = np.bincount(bins)
    kept = np.flatnonzero(number >= _MIN_PIECES)
    if len(kept) < 2:
        raise ValueError(
            f"scans show {len(distances)} pieces of walls, {_MIN_PIECES} or more of them in "
            f"{len(kept)} bins of half a metre: must be in 2 or more bins (in metres, radians?)"
        )
    within = distances < config.max_range
    middles = [np.median(distances[within][bins == i]) for i in kept]
    medians = [np.median(spread[within][bins == i]) for i in kept]
    growth, noise = np.polyfit(middles, medians, 1, w=np.sqrt(number[kept]))
    mixed, dropout = _edges(_scans(angles, ranges), config.max_range)
    found = {"range_noise": noise, "range_noise_growth": growth, "mixed_pixels": mixed}
    rounded = {name: round(max(float(x), 0.0), 5) for name, x in found.items()}
    return dataclasses.replace(config, **rounded, dropout=round(dropout, 5))


def _edges(ranges: Float[np.ndarray, "S A"], max_range: float) -> tuple[float, float]:
    """Share of edges with a mixed pixel, and of beams on one surface that drop out."""
    first, before, middle, after, last = (ranges[:, i : ranges.shape[1] - 4 + i] for i in range(5))
    with np.errstate(divide="ignore", invalid="ignore"):
        is_smooth = (np.abs(first - before) < resampling.SURFACE) & (
            np.abs(after - last) < resampling.SURFACE
        )
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
