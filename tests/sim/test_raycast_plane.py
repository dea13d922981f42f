"""Rays in a scene in the plane, and their derivatives."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

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


@pytest.fixture(
    params=[
        pytest.param("_nearest_by_one_loop", marks=pytest.mark.slow),  # compiles as long again
        "_nearest_by_two_loops",
    ]
)
def by(request, monkeypatch):
    """Both ways to find what is nearest, that of accelerators and that of CPUs."""
    find = getattr(raycast, request.param)
    for name in ("_nearest_by_one_loop", "_nearest_by_two_loops"):
        monkeypatch.setattr(raycast, name, find)
    return request.param


def test_both_ways_find_the_same_hits():
    section, rng = scene(np.float32), np.random.default_rng(0)
    starts = [*rng.uniform(-1.4, 1.4, (400, 2)), *[(0.02, -0.05), (0.03, 1.04), (2.0, 2.0)] * 40]
    angles = rng.uniform(-np.pi, np.pi, len(starts))
    ways = raycast._nearest_by_one_loop, raycast._nearest_by_two_loops
    rays = np.float32(starts).T, np.float32([np.cos(angles), np.sin(angles)])
    one, two = (
        jax.jit(jax.vmap(f, (None, 0, 0)))(section, *(tuple(x) for x in rays)) for f in ways
    )
    np.testing.assert_allclose(one[0], two[0], rtol=1e-6)
    np.testing.assert_array_equal(one[1], two[1])
    assert set(np.asarray(one[1])) == {0, 1, 3, 4, 5, len(GEOMS)}


MOST_RAYS = 16
HALF_PI = np.pi / 2


def hit(origin, angle, section):
    """`[3]` distance and both parts of the normal."""
    found = raycast.cast(section, origin, angle)
    return jnp.stack([found.distance, *found.normal])


INPUTS = 0, 1, 2


@functools.cache
def jacobians(by):
    """What `hit` gives for `[B]` rays, and its Jacobian."""
    del by  # each way is compiled once

    def of(*ray):
        return hit(*ray), jax.jacrev(hit, INPUTS)(*ray)

    return jax.jit(jax.vmap(of, in_axes=(0, 0, None)))


@pytest.fixture
def slopes(by):
    """The same for some rays in the scene."""

    def of(rays):
        origins, angles = zip(*rays, *[rays[0]] * (MOST_RAYS - len(rays)), strict=True)
        inputs = np.array(origins, np.float32), np.array(angles, np.float32), scene(np.float32)
        found = jax.device_get(jacobians(by)(*inputs))
        return jax.tree.map(lambda x: x[: len(rays)], found)

    return of


def test_slopes_as_worked_by_hand(slopes):
    # A: along x on to a circle of 0.1 about the origin, 0.06 beside its axis. It is met at
    # x = -sqrt(r^2 - y^2) = -0.08, where the normal is (-0.08, 0.06) / 0.1. With c = 0.08:
    #   distance = -x0 - c        d/dx0 = -1      d/dy0 = y/c = 0.75     d/dr = -r/c = -1.25
    #   normal_x = -c / r         d/dx0 = 0       d/dy0 = y/(c r) = 7.5  d/dr = -y^2/(c r^2) = -4.5
    #   normal_y = y / r          d/dx0 = 0       d/dy0 = 1/r = 10       d/dr = -y/r^2 = -6
    # B: along x on to the wall at 1.5: distance = 1.5 - x0, half_u counts against it.
    # C: on to the wall at y = -1.5 from 1 m away, 60 degrees from its normal: distance = 1 / cos t
    #   = 2, d/dt = sin t / cos^2 t = 2 sqrt 3, d/dy0 = 1 / cos t = 2.
    # D: from the middle of the circle along x: distance = r - x0.
    # E: on to the middle of the cube turned by 30 degrees: distance = 0.5 - h / cos yaw, d/dh =
    #   -1 / cos 30; moving y0 by d moves the side, whose normal is (-cos, -sin), by d tan 30.
    a, b, c, d, e = (-1.0, 0.06), (0.5, 0.2), (-1.0, -0.5), (0.0, 0.0), (-0.5, 1.0)
    rays = [(a, 0.0), (b, 0.0), (c, -HALF_PI + np.pi / 3), (d, 0.0), (e, 0.0)]
    values, (origin, angle, section) = slopes(rays)
    np.testing.assert_allclose(values[:, 0], [0.92, 1.0, 2.0, 0.1, 0.5 - 0.1 / np.cos(TURN)], 1e-5)
    close = functools.partial(np.testing.assert_allclose, rtol=1e-4, atol=2e-5)
    close(origin[0], [[-1.0, 0.75], [0.0, 7.5], [0.0, 10.0]])
    close(section.half[0, :, 0, 0], [-1.25, -4.5, -6.0])
    close(section.centre[0, :, 0], -origin[0])
    close(origin[1], [[-1.0, 0.0], [0.0, 0.0], [0.0, 0.0]])
    close(section.half[1, 0, 4], [-1.0, 0.0])
    close(angle[1], 0.0)
    close(origin[2, 0], [0.0, 2.0])
    close(angle[2], [2 * np.sqrt(3.0), 0.0, 0.0])
    close(origin[3, 0], [-1.0, 0.0])
    close(section.half[3, 0, 0, 0], 1.0)
    close(origin[4, 0], [-1.0, -np.tan(TURN)])
    close(section.half[4, 0, 3], [-1 / np.cos(TURN), 0.0])
    # A normal of the cube turns as its axis does: (-cos, -sin).
    close(section.axis[4, 1:, 3], [[-1.0, 0.0], [0.0, -1.0]])


def test_slopes_are_finite_for_every_ray(slopes):
    cases = [
        ((-1.0, 0.1), 0.0),  # touches a circle
        ((-1.0, np.nextafter(np.float32(0.1), np.float32(0))), 0.0),  # and by a hair cuts it
        ((0.1, 0.0), 0.0),  # starts on it, outwards
        ((0.1, 0.0), np.pi),  # and inwards
        ((-1.0, -1.5), 0.0),  # runs along a wall's side
        ((-1.0, -1.525), 0.0),  # and within it
        ((1.5, 0.0), HALF_PI),  # and starts on it
        ((1.0, -1.0), -np.pi / 4),  # runs into the corner between two walls
        ((0.0, 1.0), TURN + np.pi / 4),  # leaves the cube by its edge
        ((-0.5, 0.5), 1.0),  # starts where a circle is that is not cut
        ((-0.5, -0.5), 1.0),  # and a box
    ]
    misses = [((-0.3, 0.4), np.pi), ((-1.0, 2.0), HALF_PI), ((3.0, 0.0), 0.0)]
    values, jacobian = slopes([*cases, *misses])
    for leaf in jax.tree.leaves(jacobian):
        assert np.isfinite(leaf).all()
        np.testing.assert_array_equal(leaf[len(cases) :], 0.0)
    np.testing.assert_array_equal(values[len(cases) :], [[np.inf, 0.0, 0.0]] * len(misses))
