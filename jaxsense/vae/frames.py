"""Windows as a robot sees a PoI: without what depends on the place of the look or on the light.

A network that learns from scans without labels uses its latents first for what varies most: how far
and in which direction the PoI is, and how bright the light. A frame takes these out of a window.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsense.config.learning import PROFILE
from jaxsense.core import networks
from jaxsense.core.types import pytree

_HALF_WIDTH = 1.5  # this and what follows in extents of a PoI, the radius of a circle around it
_TO_MIDDLE = 0.35  # from the front of a PoI on, half of a small one's depth
_NEAR = 1.15  # depth within which a beam is on the PoI
_BESIDE = 1.15  # half-widths within which it is
_DEPTHS = -1.4, 2.1  # beyond which depth tells nothing of the PoI
_AHEAD = 0.1  # rad, half the width of a PoI's front
_NOTHING = 0.05  # beams on nothing that a place without any beam counts as
_DARK = 0.03  # keeps chromaticity finite


@pytree
class Frame:
    """How a network sees the windows of one sensor; here as they are."""

    def __call__(self, window: Float[Array, " F"]) -> Float[Array, " G"]:
        """The numbers that the network reads in a window, see `sim.windows.as_window`."""
        return window


@pytree
class Profile(Frame):
    """Depth over lateral position around a PoI's middle, from a window of distances.

    Attributes:
      across: `[W]` sines of the beams' angles from the middle of the window.
      along: `[W]` cosines of these angles.
      ahead: `[]` sine of the angle up to which the PoI's front is looked for.
      extent: `[]` radius of the circle that holds a PoI, in metres.
    """

    across: Float[Array, " W"]
    along: Float[Array, " W"]
    ahead: Float[Array, ""]
    extent: Float[Array, ""]

    def __call__(self, window: Float[Array, " W"]) -> Float[Array, " G"]:
        """See `Frame`: `[64]` depths in metres, from 1.5 extents on one side to 1.5 on the other.

        Each is the mean of the beams up to a bin or the pitch of the beams away, weighted by how
        near they are, and of 2.1 extents with the weight .05: the depth where no beam is near.
        """
        # One beam alone may be an outlier.
        triples = jnp.maximum(jnp.maximum(window[:-2], window[1:-1]), window[2:])
        is_ahead = jnp.abs(self.across[1:-1]) <= self.ahead
        middle = jnp.min(jnp.where(is_ahead, triples, jnp.inf)) + _TO_MIDDLE * self.extent
        half_width = _HALF_WIDTH * self.extent
        is_near = jnp.abs(window - middle) < _NEAR * self.extent
        is_near &= jnp.abs(window * self.across) < _BESIDE * half_width
        sine = jnp.sum(jnp.where(is_near, self.across, 0.0)) / jnp.maximum(jnp.sum(is_near), 1)
        cosine = jnp.sqrt(1 - sine**2)
        across = window * (self.across * cosine - self.along * sine)
        depth = window * (self.along * cosine + self.across * sine) - middle
        lowest, highest = (limit * self.extent for limit in _DEPTHS)
        pitch = jnp.abs(self.across[-1] - self.across[0]) / (len(window) - 1)
        width = jnp.maximum(2 * half_width / (PROFILE - 1), pitch * middle)
        places = half_width * jnp.linspace(-1.0, 1.0, PROFILE)
        apart = jnp.abs(across[None] - places[:, None])
        weights = jnp.maximum(0.0, 1.0 - apart / width)
        total = jnp.sum(weights * jnp.clip(depth, lowest, highest)[None], axis=1)
        return (total + _NOTHING * highest) / (jnp.sum(weights, axis=1) + _NOTHING)


@pytree
class Chromaticity(Frame):
    """Shares of red, green and blue in the brightness of each pixel, from a window of RGB.

    The mean brightness of the window is added to that of the pixel: shares of dark pixels are
    mostly noise, and become small.
    """

    def __call__(self, window: Float[Array, " F"]) -> Float[Array, " F"]:
        """See `Frame`: three shares for each pixel, which do not change with the light."""
        pixels = window.reshape(-1, 3)
        brightness = jnp.sum(pixels, axis=1, keepdims=True)
        total = brightness + jnp.mean(brightness) + _DARK
        return (pixels / total).reshape(-1)


def profile(
    angles: Float[np.ndarray, " W"],
    extent: Float[Array, ""] | float,
    bearing_error: Float[Array, ""] | float,
) -> Profile:
    """The frame for windows of distances along three rays or more.

    Args:
      angles: of the rays in the middle of the sensor's view, in radians.
      extent: radius of the circle that holds a PoI, in metres.
      bearing_error: largest error of the window's middle, in radians.
    """
    apart = jnp.asarray(angles - angles.mean(), jnp.float32)
    pitch = jnp.abs(apart[1] - apart[0])
    ahead = jnp.sin(jnp.maximum(_AHEAD + bearing_error, 1.01 * pitch))
    return Profile(jnp.sin(apart), jnp.cos(apart), ahead, jnp.float32(extent))


@pytree
class Scaling:
    """Numbers in a frame, less the `[G]` mean of a training's, in their standard deviation."""

    frame: Frame
    offset: Float[Array, " G"]
    scale: Float[Array, ""]

    def __call__(self, window: Float[Array, " F"]) -> Float[Array, " G"]:
        """See `Frame`."""
        return (self.frame(window) - self.offset) / self.scale


def scaled(frame: Frame, windows: Float[Array, "S F"]) -> tuple[Scaling, Float[Array, "S G"]]:
    """Standardises a frame by windows, which it also returns in this frame."""
    seen = jax.lax.map(frame, windows, batch_size=min(4096, len(windows)))
    offset, scale = networks.statistics(seen)
    return Scaling(frame, offset, scale), (seen - offset[None]) / scale
