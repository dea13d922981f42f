"""Windows as a robot sees a PoI: without what depends on the place of the look or on the light.

A network that learns from scans without labels uses its latents first for what varies most: how far
and in which direction the PoI is, and how bright the light. A frame takes these out of a window.
"""

from typing import Protocol

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from jaxsense.core.types import pytree

_HALF_WIDTH = 0.22  # m to each side of the PoI's middle
_BINS = 64
_AHEAD = 0.12  # rad from the middle of a window within which the PoI's front is looked for
_TO_MIDDLE = 0.05  # m from the front of a PoI on, half of a small one's depth
_NEAR = 0.16  # m, depth within which a beam is on the PoI
_DEPTHS = -0.2, 0.3  # m, beyond which depth tells nothing of the PoI
_DARK = 0.03  # keeps chromaticity finite


class Frame(Protocol):
    """How a network sees the windows of one sensor; a frozen pytree."""

    def __call__(self, window: Float[Array, " F"]) -> Float[Array, " G"]:
        """The numbers that the network reads.

        Args:
          window: `[F]` readings around the PoI's bearing, see `sim.windows.as_window`.
        """
        ...


@pytree
class Profile:
    """Depth over lateral position around a PoI's middle, from a window of distances.

    Attributes:
      angles: `[W]` of the beams from the middle of the window, in radians.
    """

    angles: Float[Array, " W"]

    def __call__(self, window: Float[Array, " W"]) -> Float[Array, " G"]:
        """See `Frame`: `[64]` depths in metres, from 22 cm on one side to 22 cm on the other."""
        ahead = jnp.where(jnp.abs(self.angles) < _AHEAD, window, jnp.inf)
        # The nearest one may be an outlier.
        middle = -jnp.mean(jax.lax.top_k(-ahead, 4)[0][1:]) + _TO_MIDDLE
        is_near = jnp.abs(window - middle) < _NEAR
        is_near &= jnp.abs(self.angles) < jnp.arctan2(1.15 * _HALF_WIDTH, middle)
        total = jnp.maximum(jnp.sum(is_near), 1)
        angles = self.angles - jnp.sum(jnp.where(is_near, self.angles, 0.0)) / total
        across, depth = window * jnp.sin(angles), window * jnp.cos(angles) - middle
        order = jnp.argsort(across)
        places = jnp.linspace(-_HALF_WIDTH, _HALF_WIDTH, _BINS)
        return jnp.interp(places, across[order], jnp.clip(depth[order], *_DEPTHS))


@pytree
class Chromaticity:
    """Two shares of the brightness and its logarithm for each pixel, from a window of RGB."""

    def __call__(self, window: Float[Array, " F"]) -> Float[Array, " F"]:
        """See `Frame`: the shares of red and green, and the logarithm, for each pixel."""
        pixels = window.reshape(-1, 3)
        total = jnp.sum(pixels, axis=1, keepdims=True) + _DARK
        return jnp.concatenate([pixels[:, :2] / total, jnp.log(total)], axis=1).reshape(-1)


@pytree
class Plain:
    """The window as it is."""

    def __call__(self, window: Float[Array, " F"]) -> Float[Array, " F"]:
        """See `Frame`."""
        return window


def make(angles: Float[np.ndarray, " W"], channels: int, measures_distance: bool) -> Frame:
    """The frame for windows of a sensor.

    Args:
      angles: `[W]` of the rays in the middle of its view, in radians.
      channels: numbers in the reading of one ray.
      measures_distance: whether readings are distances in metres.
    """
    if measures_distance and channels == 1:
        return Profile(jnp.asarray(angles - angles.mean(), jnp.float32))
    return Chromaticity() if channels == 3 else Plain()


@struct.dataclass
class Scaling:
    """Numbers in a frame, standardised by those of a training.

    Attributes:
      frame: of the sensor.
      offset: `[G]` mean of the training's.
      scale: `[]` their overall standard deviation.
    """

    frame: Frame
    offset: Float[Array, " G"]
    scale: Float[Array, ""]

    def __call__(self, window: Float[Array, " F"]) -> Float[Array, " G"]:
        """See `Frame`."""
        return (self.frame(window) - self.offset) / self.scale


def scaled(frame: Frame, windows: Float[Array, "S F"]) -> tuple[Scaling, Float[Array, "S G"]]:
    """Standardises a frame by windows for training, which it also returns in this frame.

    Args:
      frame: of the sensor.
      windows: `[S, F]`.
    """
    seen = jax.lax.map(frame, windows, batch_size=min(4096, len(windows)))
    offset = jnp.mean(seen, axis=0)
    scale = jnp.std(seen - offset[None]) + 1e-6
    return Scaling(frame, offset, scale), (seen - offset[None]) / scale
