"""Scans along other rays than they were recorded along, with NumPy alone.

Robots copy this file; it imports neither JAX nor the rest of jaxsense.
"""

import numpy as np

_TURN = 2 * np.pi + 1e-3  # rad; drivers round the last angle
_ROUNDING = 1e-6  # rad
MAX_STEPS = 3.0
"""Widest gap between two recorded rays, in steps of the rays that are read."""
MAX_LOST = 5
"""Beams in a row that may have been lost; where more have no return, nothing is near."""
SURFACE = 0.1
"""Metres; neighbouring beams that differ by more hit two surfaces."""


def resample(
    targets: np.ndarray,
    angles: np.ndarray,
    readings: np.ndarray,
    *,
    measures_distance: bool,
    step: float | None = None,
) -> np.ndarray:
    """Readings along other rays, NaN where nothing was recorded, see `covered`.

    Readings are interpolated between two recorded rays, distances only on one surface; elsewhere
    the nearest ray counts. A distance of 0 is no return and becomes infinite. The last ray of a
    full circle has the first as its neighbour. Recorded rays may come in any order, unevenly
    spaced, as those of several sweeps.

    Args:
      targets: `[B]` directions of the rays to read along, in radians.
      angles: `[A]` directions of the recorded rays in the same frame, in radians; two or more.
      readings: `[A, ...]` recorded distances in metres, or other readings.
      step: see `covered`.
    """
    require_angles("angles", angles)
    if np.size(angles) < 2:
        raise ValueError(f"angles of {np.size(angles)} rays: must be of two or more")
    if np.shape(readings)[:1] != np.shape(angles):
        expected = f"must be one for each of {np.size(angles)} angles"
        raise ValueError(f"readings have the shape {np.shape(readings)}: {expected}")
    right, left, share, is_between, is_covered = _neighbours(targets, angles, step)
    readings = with_returns(readings) if measures_distance else np.asarray(readings, np.float32)
    first, second = readings[right], readings[left]
    # One number for each ray, next to readings of any shape.
    of_rays = (-1, *[1] * (readings.ndim - 1))
    share, is_between = share.reshape(of_rays), is_between.reshape(of_rays)
    with np.errstate(invalid="ignore"):  # a beam without a return is infinitely long
        between = first + share * (second - first)
        is_same = np.abs(second - first) < SURFACE if measures_distance else True
    nearest = np.where(share < 0.5, first, second)
    found = np.where(is_between & is_same, between, nearest).astype(np.float32)
    found[~is_covered] = np.nan
    return found


def with_returns(ranges: np.ndarray) -> np.ndarray:
    """Distances as float32, infinite instead of 0 where a beam has no return."""
    ranges = np.asarray(ranges, np.float32)
    return np.where(ranges == 0, np.float32(np.inf), ranges)


def close_gaps(angles: np.ndarray, ranges: np.ndarray, step: float | None = None) -> np.ndarray:
    """Distances with gaps of lost beams filled by the nearest neighbour.

    A gap is up to `MAX_LOST` beams in a row without a return, between two that have one. Gaps next
    to something too near (minus infinity) or to directions that were not recorded stay. The last
    beam of a full circle has the first as its neighbour.

    Args:
      angles: `[A]` directions of the beams, in radians, in any order.
      ranges: `[A]` distances in metres; 0, infinite or NaN without a return.
      step: angle between the rays that are read later, in radians; beams farther apart than
        `MAX_STEPS` of it are no neighbours. By default the median one between beams.
    """
    require_angles("angles", angles)
    ranges = with_returns(ranges)
    if ranges.shape != np.shape(angles):
        expected = f"must be one for each of {np.size(angles)} angles"
        raise ValueError(f"ranges have the shape {ranges.shape}: {expected}")
    turned = within_a_turn(angles)
    order = np.argsort(turned, kind="stable")
    # Beyond both ends of the turn, where a circle, or a scan across its back, continues.
    beams = np.tile(order, 3)
    along = turned[beams] + np.repeat([-2 * np.pi, 0.0, 2 * np.pi], len(order))
    # What was not recorded separates beams.
    step = median_step(angles) if step is None else step
    part = np.cumsum(np.diff(along, prepend=along[:1]) > MAX_STEPS * step + _ROUNDING)
    is_lost = (np.isnan(ranges) | (ranges == np.inf))[beams]
    known, here = np.flatnonzero(~is_lost), np.arange(len(beams))
    if not len(known):
        return ranges
    behind = np.searchsorted(known, here)
    left, right = (known[np.clip(i, 0, len(known) - 1)] for i in (behind - 1, behind))
    is_short = (left < here) & (here < right) & (right - left <= MAX_LOST + 1)
    is_short &= part[left] == part[right]
    has_both = np.isfinite(ranges[beams[left]]) & np.isfinite(ranges[beams[right]])
    nearest = np.where(here - left <= right - here, left, right)
    closed = np.where(is_lost & is_short & has_both, ranges[beams[nearest]], ranges[beams])
    found = ranges.copy()
    found[order] = closed[len(order) : 2 * len(order)]
    return found


def require_angles(name: str, angles: np.ndarray) -> None:
    """Raises `ValueError` if an angle, in radians, is not finite or beyond a turn."""
    wrong = np.asarray(angles)[~(np.abs(angles) <= _TURN)]
    if wrong.size:
        expected = "must be from -2 pi to 2 pi (in radians?)"
        raise ValueError(f"{name} = {wrong[0]:g}: {expected}")


def covered(targets: np.ndarray, angles: np.ndarray, step: float | None = None) -> np.ndarray:
    """Which of some rays lie in the recorded field of view.

    These lie between two recorded rays at most `MAX_STEPS` steps apart, or within half a step of
    one.

    Args:
      targets: `[B]` directions of these rays, in radians.
      angles: `[A]` directions of the recorded rays, in radians, in any order; two or more.
      step: angle between the rays that are read, in radians; by default the median one of
        `targets`.
    """
    return _neighbours(targets, angles, step)[-1]


def median_step(angles: np.ndarray) -> float:
    """Median angle between neighbouring rays, in radians; infinite if there is only one."""
    steps = np.diff(np.unique(within_a_turn(angles)))
    return float(np.median(steps)) if len(steps) else np.inf


def within_a_turn(angles: np.ndarray) -> np.ndarray:
    """Angles in radians, turned to where they are from -pi to pi."""
    return (np.asarray(angles, np.float64) + np.pi) % (2 * np.pi) - np.pi


def _neighbours(targets: np.ndarray, angles: np.ndarray, step: float | None) -> tuple:
    """Recorded rays around each target.

    Returns their indices, to the right and to the left; how far the target is from one to the
    other, from 0 to 1; whether what lies between them was recorded; and whether the target was.
    """
    if step is None:
        step = median_step(targets if np.size(targets) > 1 else angles)
    turned, order = np.unique(within_a_turn(angles), return_index=True)
    # The last ray also comes before the first one, and this after the last.
    circle = np.concatenate([turned[-1:] - 2 * np.pi, turned, turned[:1] + 2 * np.pi])
    order = np.concatenate([order[-1:], order, order[:1]])
    targets = within_a_turn(targets)
    right = np.searchsorted(circle, targets, side="right") - 1
    gap = circle[right + 1] - circle[right]
    share = (targets - circle[right]) / gap
    is_between = gap <= MAX_STEPS * step + _ROUNDING
    is_covered = is_between | (np.minimum(share, 1 - share) * gap < step / 2)
    return order[right], order[right + 1], share, is_between, is_covered
