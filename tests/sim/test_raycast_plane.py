"""Rays in a scene in the plane: against plane geometry, and their derivatives."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from jaxsense import sim
from jaxsense.config import LidarConfig
from jaxsense.sim import raycast, sensors

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


@pytest.fixture(params=["_nearest_by_one_loop", "_nearest_by_two_loops"])
def by(request, monkeypatch):
    """Both ways to find what is nearest, that of accelerators and that of CPUs."""
    find = getattr(raycast, request.param)
    for name in ("_nearest_by_one_loop", "_nearest_by_two_loops"):
        monkeypatch.setattr(raycast, name, find)
    return request.param


def meets(section, i, origin, angle):
    """Distance and normal where a ray first meets one outline; by other means than the ray-caster.

    A circle by the roots of a quadratic, a rectangle by its four sides, in double precision.
    """
    along = np.array([np.cos(angle), np.sin(angle)])
    centre, axis, half = (
        x[i].astype(np.float64) for x in (section.centre, section.axis, section.half)
    )
    if not half.all():
        return []
    if i < section.num_circles:
        roots = np.roots(
            [
                1.0,
                2 * along @ (origin - centre),
                (origin - centre) @ (origin - centre) - half[0] ** 2,
            ]
        )
        return [
            (t, (origin + t * along - centre) / half[0])
            for t in roots[np.isreal(roots)].real
            if t >= 0
        ]
    found = []
    across = np.array([-axis[1], axis[0]])
    for normal, reach, side, width in (
        (axis, half[0], across, half[1]),
        (across, half[1], axis, half[0]),
    ):
        for sign in (1, -1):
            if along @ normal == 0:
                continue
            t = (reach - sign * normal @ (origin - centre)) / (sign * normal @ along)
            if t >= 0 and abs(side @ (origin + t * along - centre)) <= width:
                found.append((t, sign * normal))
    return found


def test_hits_are_those_of_plane_geometry(by):
    section = scene(np.float32)
    rng = np.random.default_rng(0)
    starts = [*rng.uniform(-1.4, 1.4, (8, 2)), (0.02, -0.05), (0.03, 1.04), (1.51, 0.3), (2.0, 2.0)]
    met, cast = set(), jax.jit(lambda origin, angles: raycast.cast(section, origin, angles))
    for origin in np.array(starts, np.float32):
        angles = rng.uniform(-np.pi, np.pi, 40).astype(np.float32)
        angles[:7] = np.arctan2(*(section.centre - origin).T[::-1])  # on to the middle of each
        hits = jax.device_get(cast(origin, angles))
        for r, angle in enumerate(angles.astype(np.float64)):
            all_met = [
                (t, section.geom[i], normal)
                for i in range(len(section.geom))
                for t, normal in meets(section, i, origin.astype(np.float64), angle)
            ]
            expected = min(all_met, key=lambda found: found[0], default=(np.inf, -1, np.zeros(2)))
            met.add(expected[1])
            assert hits.distance[r] == pytest.approx(expected[0], abs=2e-5)
            assert hits.geom[r] == expected[1]
            normal = np.array([part[r] for part in hits.normal])
            np.testing.assert_allclose(normal, expected[2], atol=1e-3)
    assert met == {5, 2, 4, 11, 7, -1}


def test_a_ray_that_starts_on_a_side_meets_it_at_once(by):
    one = [np.float32([x]) for x in ([0.0, 0.0], [1.0, 0.0], [0.25, 0.25])]
    section = raycast.CrossSection(*one, geom=(3,), num_circles=0)
    hit = raycast.cast(section, np.float32([-0.25, 0.0]), np.float32(0.0))
    assert (float(hit.distance), int(hit.geom)) == (0.0, 3)


STEP = 1e-6  # of central differences, in double precision
MOST_RAYS = 16
HALF_PI = np.pi / 2


def hit(origin, angle, section):
    """`[3]` distance and both parts of the normal."""
    found = raycast.cast(section, origin, angle)
    return jnp.stack([found.distance, *found.normal])


INPUTS = 0, 1, 2


@pytest.mark.slow
def test_slopes_are_those_of_finite_differences(by):
    rng = np.random.default_rng(0)
    with jax.enable_x64(True):
        section = scene(np.float64)
        origins = rng.uniform(-1.4, 1.4, (100, 2))
        origins[:10] = 0.05 * origins[:10]  # within the first circle
        origins[10:20] = [0.0, 1.0] + 0.05 * origins[10:20]  # within the cube
        angles = rng.uniform(-np.pi, np.pi, 100)
        numbers, unravel = ravel_pytree((origins[0], angles[0], section))

        values = jax.jit(jax.vmap(lambda start: hit(*unravel(start))))
        starts = np.column_stack([origins, angles, np.tile(numbers[3:], (100, 1))])
        steps = STEP * np.eye(len(numbers))
        around = [starts[:, None] + sign * steps for sign in (1, -1)]
        after, before = (values(x.reshape(-1, len(numbers))).reshape(100, -1, 3) for x in around)
        expected = np.swapaxes((after - before) / (2 * STEP), 1, 2)
        met = np.isfinite(values(np.tile(starts, (len(numbers), 1)))[:100, 0])
        jacobian = jax.jit(jax.vmap(jax.jacrev(hit, INPUTS), in_axes=(0, 0, None)))
        parts = [
            np.reshape(x, (100, 3, -1)) for x in jax.tree.leaves(jacobian(origins, angles, section))
        ]
    found = np.concatenate(parts, axis=-1)
    assert 5 <= (~met).sum() <= 50
    np.testing.assert_allclose(found[met], expected[met], rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(found[~met], 0.0)
    # Centre, axis and half of each outline that is cut matter; a circle has one radius, no axis.
    centre, axis, half = np.abs(expected[met]).max(axis=(0, 1))[3:].reshape(3, -1, 2)
    assert (centre[[0, 1, 3, 4, 5]].max(axis=-1) > 0.1).all()
    assert (axis[[3, 4, 5]].max(axis=-1) > 0.1).all()
    assert (half[[0, 1, 3, 4, 5], [0, 0, 0, 0, 1]] > 0.1).all()


@functools.cache
def jacobians(by):
    """What `hit` gives for `[B]` rays, and its Jacobian, backwards and forwards."""
    del by  # each way is compiled once

    def of(*ray):
        return hit(*ray), jax.jacrev(hit, INPUTS)(*ray), jax.jacfwd(hit, INPUTS)(*ray)

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
    values, back, forth = slopes(rays)
    origin, angle, section = back
    np.testing.assert_allclose(values[:, 0], [0.92, 1.0, 2.0, 0.1, 0.5 - 0.1 / np.cos(TURN)], 1e-5)
    close = functools.partial(np.testing.assert_allclose, rtol=1e-4, atol=2e-5)
    jax.tree.map(close, back, forth)
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
    values, *jacobian = slopes([*cases, *misses])
    for leaf in jax.tree.leaves(jacobian):
        assert np.isfinite(leaf).all()
        np.testing.assert_array_equal(leaf[len(cases) :], 0.0)
    np.testing.assert_array_equal(values[len(cases) :], [[np.inf, 0.0, 0.0]] * len(misses))


@pytest.mark.slow
def test_slopes_reach_through_the_arena(arena, place, known_layout):
    """Readings of the LiDAR in where its robot and the PoIs are, through the kinematics of MJX."""
    lidar = sensors.lidar(LidarConfig(range_noise=0.0))
    light = sim.Light(jnp.array([0.6, 0.0, 0.8]), jnp.float32(0.5), jnp.float32(0.5))
    ahead = jnp.array([[1.0, 0.0], [0.0, 1.0]])  # one ray along the heading, one to its left

    def readings(pose, position, yaw):
        layout = known_layout.replace(position=position, yaw=yaw)
        data = sim.place(arena, layout, jnp.stack([jnp.array([1.0, 1.2, 0.0]), pose]))
        args = lidar, arena, data, layout, light, 1, ahead
        return sim.scan(jax.random.key(0), *args)

    # The cube at (0, 1) is turned by 30 degrees; its side is met 0.1 / cos 30 before its middle.
    pose = jnp.array([-0.5, 1.0, 0.0])
    both = jax.jit(lambda *x: (readings(*x), jax.jacfwd(readings, (0, 1, 2))(*x)))
    inputs = pose, known_layout.position, known_layout.yaw
    found, (of_pose, of_position, of_yaw) = jax.device_get(both(*inputs))
    away = 0.5 - 0.1 / np.cos(TURN)
    np.testing.assert_allclose(found, [away, 0.5], atol=1e-5)
    tan = np.tan(TURN)
    # Turning by d moves the place that is met by away * d to the left, as moving y would.
    np.testing.assert_allclose(of_pose[0], [-1.0, -tan, -away * tan], atol=1e-4)
    np.testing.assert_allclose(of_position[0, 1], [1.0, tan], atol=1e-4)
    # d/dyaw (-h / cos yaw) = -h sin yaw / cos^2 yaw
    np.testing.assert_allclose(of_yaw[0, 1], -0.1 * 0.5 / 0.75, atol=1e-4)
    # The wall is 0.5 to the left, at a right angle.
    np.testing.assert_allclose(of_pose[1], [0.0, -1.0, 0.0], atol=1e-4)
    np.testing.assert_array_equal(of_position[1], 0.0)
