"""Directions of a sensor's rays, in the robot's frame."""

import dataclasses
from typing import Protocol, runtime_checkable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsense.core import checks


@runtime_checkable
class Rays(Protocol):
    """Directions of B rays; frozen and hashable, static under `jit`."""

    @property
    def angles(self) -> Float[np.ndarray, "B"]:
        """Angles in the robot's frame, in radians, in the order of the readings."""
        ...

    def centre(self, bearing: Float[Array, ""]) -> Float[Array, ""]:
        """Real-valued index of the ray along a bearing, in radians."""
        ...


@dataclasses.dataclass(frozen=True)
class Fan:
    """Rays at equal angles, from right to left.

    Attributes:
      num_rays: number of rays, B.
      field_of_view: angle between the first and the last ray, in degrees.

    Raises:
      ValueError: if there are no rays, or the field of view is not in (0, 360].
    """

    num_rays: int
    field_of_view: float

    def __post_init__(self):
        checks.require_number("num_rays", self.num_rays)
        is_angle = "must be above 0 and at most 360 degrees"
        checks.require(
            "field_of_view", self.field_of_view, lambda x: (x > 0) & (x <= 360), is_angle
        )

    @property
    def _half(self) -> float:
        return float(np.radians(self.field_of_view)) / 2

    @property
    def angles(self) -> Float[np.ndarray, "B"]:
        """See `Rays.angles`."""
        first = -self._half if self.num_rays > 1 else 0.0  # one ray points ahead
        return np.linspace(first, self._half, self.num_rays, dtype=np.float32)

    def centre(self, bearing: Float[Array, ""]) -> Float[Array, ""]:
        """See `Rays.centre`."""
        return (bearing - self.angles[0]) / (2 * self._half / max(self.num_rays - 1, 1))


@dataclasses.dataclass(frozen=True)
class Pinhole:
    """Rays through the pixels of a pinhole camera's scanline, from left to right.

    Attributes:
      num_pixels: number of pixels, B.
      field_of_view: angle between the outer edges of the first and the last pixel, in degrees.

    Raises:
      ValueError: if there are no pixels, or the field of view is not in (0, 180).
    """

    num_pixels: int
    field_of_view: float

    def __post_init__(self):
        checks.require_number("num_pixels", self.num_pixels)
        is_angle = "must be above 0 and below 180 degrees"
        checks.require("field_of_view", self.field_of_view, lambda x: (x > 0) & (x < 180), is_angle)

    @property
    def _middle(self) -> float:
        return (self.num_pixels - 1) / 2

    @property
    def _focal_length(self) -> float:
        return (self.num_pixels / 2) / float(np.tan(np.radians(self.field_of_view) / 2))

    @property
    def angles(self) -> Float[np.ndarray, "B"]:
        """See `Rays.angles`."""
        columns = np.arange(self.num_pixels)
        return np.arctan((self._middle - columns) / self._focal_length).astype(np.float32)

    def centre(self, bearing: Float[Array, ""]) -> Float[Array, ""]:
        """See `Rays.centre`."""
        return self._middle - self._focal_length * jnp.tan(bearing)
