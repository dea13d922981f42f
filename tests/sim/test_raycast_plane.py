"""Rays in a scene in the plane, without arena and compiler, against plane geometry."""

import jax
import numpy as np
import pytest
from sections import scene

from jaxsense.sim import raycast


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
