"""Proposals: candidates for points of interest in one whole scan, whose place nobody has told.

A candidate is an upright body of a known size in the open. Detectors check afterwards what it is.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Shaped

from jaxsense.core.types import pytree, within_a_turn
from jaxsense.sim.sensors import Sensor

_GROWTH = 0.5  # of noise, per metre, in shares of that at 0 m: LiDARs have .1 to .5
_JUMP = 0.04, 3.0, 6.0  # m; noises; spacings of beams: a surface that is met at 10 degrees
_EXPLAINED = 0.03, 2.5  # m; noises
_FREE = 1e4  # m, where no beam returns
_GREY = 0.2  # chroma of a surface, in shares of its brightness, below which it may be grey
_LEAST, _CLEAR = 2.1, 3.8  # noises of the chroma of a pixel, and of an interval
_TURN = 0.75, 1.6  # cosine of two hues, that of red and yellow is .61; noises
_WIDE = 1.15, 0.14  # mean half-width of cylinders and cubes in radii, and its deviation as a share

RGB = 3
"""Channels of a sensor whose images show bodies."""
Rows = Shaped[Array | np.ndarray, " A"]
"""One number for each ray of a scan, see `_in_order`."""


@pytree
class Candidates:
    """Candidates for points of interest, C rows, the nearest first.

    Attributes:
      bearing: in the robot's frame, in radians.
      distance: of the centre, in metres.
      position: of the centre, in metres, in the frame of the robot's pose.
      covariance: of the position, in square metres; that of the pose is not part of it.
      is_valid: whether there is a candidate in this row; the others hold any finite numbers.
    """

    bearing: Float[Array, " C"]
    distance: Float[Array, " C"]
    position: Float[Array, "C 2"]
    covariance: Float[Array, "C 2 2"]
    is_valid: Bool[Array, " C"]


def propose(
    sensor: Sensor,
    readings: Float[Array, "B *channels"],
    pose: Float[Array, "3"],
    walls: Float[Array, "K 4"],
    circles: Float[Array, "P 3"],
    radius: Float[Array, ""] | float,
    number: int,
    narrowest: float | None = None,
) -> Candidates:
    """Candidates in a whole scan, simulated or recorded.

    Args:
      readings: of all rays, see `Sensor.read`; NaN where nothing was recorded.
      pose: of the robot: x [m], y [m] and yaw [rad].
      walls: known pieces of walls, x and y of both ends in metres.
      circles: x, y and radius of bodies that are none, in metres, such as other robots.
      radius: of a cylinder and half the side of a cube, in metres.
      number: C, at most the number of rays; static.
      narrowest: half the smallest width of a body from any side, in metres; `radius` by default.
    """
    if sensor.measures_distance:
        explained = explained_by(pose, sensor.angles, readings, walls, circles)
        given = sensor.angles, readings, max_range(sensor), pose, explained, radius, number
        return from_ranges(*given, narrowest)
    if sensor.channels == RGB:
        return from_colours(sensor.angles, readings, pose, radius, number)
    none = jnp.zeros(number)
    return _nearest(pose, none > 0, number, none, none, none, none)


def max_range(sensor: Sensor) -> Float[Array, ""]:
    """Reading without a return, in metres; a sensor of one's own may have none."""
    return jnp.where(sensor.blind > 0, sensor.blind, jnp.inf)


def reach(sensor: Sensor, narrowest: float) -> Float[Array, ""]:
    """Metres up to which `propose` shows bodies: five beams, or a tenth of a radian, wide.

    Args:
      narrowest: half the smallest width of a body, in metres.
    """
    if sensor.measures_distance:
        spacing = abs(float(sensor.angles[1] - sensor.angles[0]))
        return jnp.minimum(2 * narrowest / (5 * spacing), max_range(sensor))
    return jnp.asarray(20.0 * narrowest if sensor.channels == RGB else 0.0)


def explained_by(
    pose: Float[Array, "3"],
    angles: Float[np.ndarray, " B"],
    ranges: Float[Array, " B"],
    walls: Float[Array, "K 4"],
    circles: Float[Array, "P 3"],
) -> Bool[Array, " B"]:
    """Which beams end on known walls or in known circles, as far as the noise of the scan tells."""
    has_return = (ranges > 0) & jnp.isfinite(ranges)
    ranges = jnp.where(has_return, ranges, 0.0)
    margin = _EXPLAINED[0] + _EXPLAINED[1] * _noise(ranges, has_return) * (1 + _GROWTH * ranges)
    ends = pose[None, :2] + ranges[:, None] * _unit(angles + pose[2])
    pieces = jnp.concatenate([jnp.pad(walls, ((0, 0), (0, 1))), circles[:, [0, 1, 0, 1, 2]]])
    along, apart = (pieces[:, 2:4] - pieces[:, :2])[None], ends[:, None] - pieces[None, :, :2]
    share = jnp.clip(jnp.sum(apart * along, -1) / (jnp.sum(along**2, -1) + 1e-12), 0.0, 1.0)
    off = jnp.linalg.norm(apart - share[..., None] * along, axis=-1) - pieces[None, :, 4]
    return has_return & jnp.any(off <= margin[:, None], axis=1)


def from_ranges(
    angles: Float[np.ndarray, " B"],
    ranges: Float[Array, " B"],
    max_range: Float[Array, ""] | float,
    pose: Float[Array, "3"],
    explained: Bool[Array, " B"],
    radius: Float[Array, ""] | float,
    number: int,
    narrowest: float | None = None,
) -> Candidates:
    """Candidates in a scan of a LiDAR: segments as wide as a body, in front of both neighbours.

    The middle half of a body's front lies on average .98 radii in front of the centre of a cylinder
    or a cube that is seen at right angles, both two radii wide, and at most 1.06 of a wider cube.

    Args:
      ranges: in metres; 0, or `max_range` and more, without a return; NaN if not recorded.
      explained: which beams end on known walls or robots, see `explained_by`.
    """
    order, along = _in_order(angles)
    ranges, explained = ranges[order], explained[order]
    has_return = (ranges > 0) & (ranges < max_range)
    # Nothing is in front of what was not recorded.
    ranges = jnp.where(has_return, ranges, jnp.where(jnp.isnan(ranges), 0.0, _FREE))
    # The median of five beams has neither outliers nor lost beams, and keeps edges.
    padded = jnp.pad(ranges, 2, mode="edge")
    smooth = jnp.sort(jnp.stack([padded[i : i + len(ranges)] for i in range(5)]), axis=0)[2]
    noise, spacing = _noise(ranges, has_return) * (1 + _GROWTH * smooth), np.gradient(along)
    limit = _JUMP[0] + _JUMP[1] * noise + _JUMP[2] * spacing * smooth
    jump = jnp.diff(smooth)
    is_cut = jnp.abs(jump) > jnp.minimum(limit[1:], limit[:-1])
    first, last, bearing, angle, is_whole = _segments(is_cut, along, len(angles))
    in_front = (jump[first - 1] < 0) & (jump[jnp.minimum(last, len(jump) - 1)] > 0)

    kept = jnp.where(jnp.abs(ranges - smooth) <= limit, ranges, smooth) * (smooth < _FREE)
    quarter = (last - first + 1) // 4
    middle = _mean(kept[:, None] * _unit(along), first + quarter, last - quarter)
    front = jnp.sum(middle * _unit(bearing), axis=-1)
    half_width = (front + radius) * jnp.sin(angle)
    least = radius if narrowest is None else narrowest
    deep = jnp.clip(half_width, least, radius)  # a body is taken to be as deep as it is wide
    distance = front + 0.98 * deep + 0.2 * jnp.clip(half_width - radius, 0.0, 0.414 * radius)

    slack = spacing[0] * distance
    # Half a body is up to 1.41 radii wide, and what edges make of it.
    is_wide = (half_width > 0.65 * least) & (half_width < 1.65 * radius + slack)
    depth = jnp.maximum(smooth[first], smooth[last]) - front
    is_body = is_whole & in_front & is_wide & (depth < 2 * radius + 3 * noise)
    is_body &= (smooth < max_range) & (_mean(explained[:, None], first, last)[:, 0] < 0.5)
    ahead = noise**2 / (last - first + 1 - 2 * quarter) + (0.036 * radius) ** 2
    # The middle between both edges of a near cube is not in the direction of its centre.
    aside = (0.22 * slack) ** 2 + (0.025 * radius) ** 2 + (0.35 * radius**2 / distance) ** 2
    return _nearest(pose, is_body, number, bearing, distance, ahead, aside)


def from_colours(
    angles: Float[np.ndarray, " B"],
    rgb: Float[Array, "B 3"],
    pose: Float[Array, "3"],
    radius: Float[Array, ""] | float,
    number: int,
) -> Candidates:
    """Candidates in a scanline of a camera: intervals of a colour that most of the image lacks.

    Light changes brightness, and the colour of the light is that of most of the image. The width of
    an interval tells the distance, as far as the shape of a body is known.

    Args:
      rgb: linear, from 0 to 1; NaN if not recorded.
    """
    order, along = _in_order(angles)
    is_known = jnp.all(jnp.isfinite(rgb[order]), axis=1)
    pixels = jnp.where(is_known[:, None], rgb[order], 0.0)
    # Less than half a body at 2.5 m, 0.03 rad.
    widest = max(1, round(0.03 / float(np.median(np.diff(along)))))
    # A pixel is the light on grey, of any brightness, and its chroma.
    coarse = _smooth(pixels, widest)
    share = coarse / (jnp.sum(coarse, axis=1, keepdims=True) + 1e-9)
    # Light has all colours; what reflects little of one is a near body, maybe in most of the image.
    usable = is_known & jnp.all((coarse < 0.99) & (share > 0.15), axis=1)
    light = jnp.nanmedian(jnp.where(usable[:, None], share, jnp.nan), axis=0, keepdims=True)
    light = jnp.nan_to_num(light / jnp.linalg.norm(light), nan=3**-0.5)
    chroma = pixels - jnp.sum(pixels * light, axis=1, keepdims=True) * light
    # The median of the squared length of two normal numbers is 2 log 2, of differences 4 log 2.
    noise = jnp.sqrt(jnp.median(jnp.sum(jnp.diff(chroma, axis=0) ** 2, axis=1)) / 2.77)

    # Smooth until noise is a fifth of what may be grey.
    grey = _GREY * jnp.sum(coarse * light, axis=1)
    half = jnp.minimum((5 * noise / (jnp.median(grey) + 1e-6)) ** 2 / 2, widest).astype(jnp.int32)
    smooth = _smooth(chroma, half)
    level = jnp.linalg.norm(smooth, axis=1) + 1e-6
    remaining = noise / jnp.sqrt(2.0 * half + 1)
    limit = jnp.maximum(_LEAST * remaining, grey)
    is_coloured = is_known & (level > limit)
    here, hue = np.arange(1, len(along)), smooth / level[:, None]
    left, right = jnp.maximum(here - 1 - half, 0), jnp.minimum(here + half, len(along) - 1)
    slack = _TURN[1] * remaining / jnp.minimum(level[left], level[right])
    is_turn = jnp.sum(hue[left] * hue[right], axis=1) < _TURN[0] - slack
    is_turn &= is_coloured[left] & is_coloured[right]
    is_cut = (is_coloured[1:] != is_coloured[:-1]) | is_turn
    first, last, bearing, angle, is_whole = _segments(is_cut, along, len(angles))

    pixels_in = last - first + 1
    mean = jnp.linalg.norm(_mean(chroma, first, last), axis=1) + 1e-6
    # Smoothing widens an interval where the limit is below half of its chroma.
    added = (2 * half + 1) * jnp.clip(1 - 2 * limit / mean, -1.0, 1.0) / pixels_in
    angle *= jnp.maximum(1 - added, 0.5)
    distance = _WIDE[0] * radius / jnp.sin(angle)
    is_body = is_whole & is_coloured & (mean * jnp.sqrt(pixels_in) > _CLEAR * noise)
    is_body &= is_known[first - 1] & is_known[jnp.minimum(last + 1, len(along) - 1)]
    of_edges = (1 + 2 * half * noise / mean) / pixels_in  # as a share of the width
    ahead = distance**2 * (_WIDE[1] ** 2 + of_edges**2)
    aside = (distance * angle * of_edges) ** 2 + (0.1 * radius) ** 2
    return _nearest(pose, is_body, number, bearing, distance, ahead, aside)


def _unit(angle: Float[Array | np.ndarray, " B"]) -> Float[Array, "B 2"]:
    """Unit vectors along angles, in radians."""
    return jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)


def _noise(ranges: Float[Array, " B"], has_return: Bool[Array, " B"]) -> Float[Array, ""]:
    """Robust standard deviation of a range of 0 m, from second differences.

    Beams without a return may read a number, always the same: no difference tells nothing.
    """
    ranges = jax.lax.stop_gradient(jnp.where(has_return, ranges, jnp.nan))
    second = jnp.abs(jnp.diff(ranges, n=2)) / (1 + _GROWTH * ranges[1:-1])
    # The median of a normal number is .674 deviations, here of sqrt(6) times the noise.
    return jnp.nan_to_num(jnp.nanmedian(jnp.where(second > 0, second, jnp.nan))) / 1.65


def _in_order(angles: Float[np.ndarray, " B"]) -> tuple[np.ndarray, np.ndarray]:
    """Indices and angles of A rays from right to left.

    The first quarter of a full circle follows once more, so that no body is cut in two.
    """
    order = np.argsort(angles, kind="stable")
    turned = angles[order].astype(np.float64)
    again = (np.ptp(turned) + 1.5 * np.median(np.diff(turned)) > 2 * np.pi) * len(order) // 4
    order = np.concatenate([order, order[:again]])
    return order, np.concatenate([turned, turned[:again] + 2 * np.pi])


def _segments(is_cut: Bool[Array, " _"], along: np.ndarray, number: int) -> tuple[Rows, ...]:
    """Segments between cuts, in the rows of their first rays.

    Args:
      along: angles of the rays.
      number: of rays of the scan; a segment that begins later is there once before.

    Returns:
      First and last ray, middle and half of the angle [rad], and which segments have three rays or
      more and end inside the scan.
    """
    first, rows = np.arange(len(along)), jnp.asarray(along, jnp.float32)
    cuts = jnp.where(jnp.append(True, is_cut), first, len(along))
    following = jnp.append(jax.lax.cummin(cuts, reverse=True)[1:], len(along))
    last = jnp.where(cuts == first, following - 1, first)
    step = jnp.asarray(np.gradient(along), jnp.float32)[(first + last) // 2]
    angle = jnp.minimum((rows[last] - rows[first] + step) / 2, np.pi / 2)
    is_inside = (first > 0) & (first <= number) & (last < len(along) - 1)
    return first, last, (rows[first] + rows[last]) / 2, angle, is_inside & (last - first >= 2)


def _mean(values: Shaped[Array, "A N"], first: Rows, last: Rows) -> Float[Array, "A N"]:
    """Means from first to last rows."""
    sums = jnp.pad(jnp.cumsum(values, axis=0), ((1, 0), (0, 0)))
    return (sums[last + 1] - sums[first]) / (last - first + 1)[:, None]


def _smooth(values: Float[Array, "A N"], half: Int[Array, ""] | int) -> Float[Array, "A N"]:
    """Means over `half` rays to both sides."""
    here = jnp.arange(len(values))
    return _mean(values, jnp.maximum(here - half, 0), jnp.minimum(here + half, len(values) - 1))


def _nearest(
    pose: Float[Array, "3"], is_valid: Bool[Array, " A"], number: int, *columns: Rows
) -> Candidates:
    """The nearest valid candidates.

    Args:
      columns: bearing [rad], distance [m], and variances along and across the ray [m2].
    """
    _, rows = jax.lax.top_k(-jnp.where(is_valid, columns[1], jnp.inf), number)
    bearing, distance, *variances = (x[rows] for x in columns)
    ray = _unit(bearing + pose[2])
    position, variance = pose[None, :2] + distance[:, None] * ray, jnp.stack(variances, axis=1)
    axes = jnp.stack([ray, ray[:, ::-1] * jnp.array([[-1.0, 1.0]])], axis=1)
    covariance = jnp.sum(variance[..., None, None] * axes[..., None] * axes[:, :, None], axis=1)
    return Candidates(within_a_turn(bearing), distance, position, covariance, is_valid[rows])
