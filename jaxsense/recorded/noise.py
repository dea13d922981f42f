"""The noise of a LiDAR, fitted to recorded scans with NumPy."""

import dataclasses

import numpy as np
import scipy.special
from jaxtyping import Float

from jaxsense.config import LidarConfig
from jaxsense.core import checks
from jaxsense.recorded import resampling

_BEAMS = 15  # of a piece of wall
_MIN_FACING = 0.5  # cosine of the angle at which a beam meets a wall
_MIN_PIECES = 20  # in a bin of distances
_EDGE = 0.5  # m between the surfaces of an edge
_MARGIN = 0.15  # m between a mixed pixel and both surfaces


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
    ranges = _scans(angles, ranges)
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


def _scans(angles: np.ndarray, ranges: np.ndarray) -> Float[np.ndarray, "S A"]:
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
