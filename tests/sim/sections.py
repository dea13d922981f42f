"""A scene in the plane for tests of rays, made without an arena."""

import numpy as np

from jaxsense.sim import raycast

TURN = np.radians(30.0)
GEOMS = (5, 2, 9, 4, 11, 7, 3)


def outlines(*rows):
    """Centre, axis and half sides from `(x, y, yaw, half_u, half_v)` of each outline."""
    x, y, yaw, half_u, half_v = np.array(rows, np.float64).T
    pairs = (x, y), (np.cos(yaw), np.sin(yaw)), (half_u, half_v)
    return [np.stack(pair, axis=-1) for pair in pairs]


def scene(dtype):
    """Two circles, a cube turned by 30 degrees, two walls, and one of each that is not cut."""
    arrays = outlines(
        (0.0, 0.0, 0.0, 0.1, 0.1),
        (0.8, 0.5, 0.0, 0.05, 0.05),
        (-0.5, 0.5, 0.0, 0.0, 0.0),
        (0.0, 1.0, TURN, 0.1, 0.1),
        (1.525, 0.0, 0.0, 0.025, 1.55),
        (0.0, -1.525, 0.0, 1.55, 0.025),
        (-0.5, -0.5, 0.0, 0.0, 0.0),
    )
    return raycast.CrossSection(*(x.astype(dtype) for x in arrays), GEOMS, 3)
