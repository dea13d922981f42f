"""Metrics of a latent space, by hand."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxsense.core.types import Belief
from jaxsense.vae import gaussian, latent

CLASS_MEANS = jnp.array([[0.0, 0.0], [3.0, 0.0], [0.0, 4.0]])


def belief(mean, std):
    return Belief(jnp.array(mean), jnp.array(std))


def test_sigma_norm_is_the_euclidean_norm_over_the_last_axis():
    # sqrt(9 + 16) = 5, sqrt(.36 + .64) = 1.
    np.testing.assert_allclose(
        latent.sigma_norm(jnp.array([[3.0, 4.0], [0.6, 0.8]])), [5.0, 1.0], rtol=1e-6
    )


def test_active_units_counts_dimensions_whose_means_vary():
    # Variances of +-a: a^2 = 1, .0144, .0064 and 0, of which two exceed .01; an offset is no use.
    mean = jnp.array([[1.0, 0.12, 0.08, 7.0], [-1.0, -0.12, -0.08, 7.0]])
    assert latent.active_units(mean) == 2


@pytest.mark.parametrize(
    ("mean", "std", "expected"),
    [
        # Distances 0, 3/1 and 4/1: only the first is within 2.
        ((0.0, 0.0), (1.0, 1.0), (True, False, False)),
        # Distances in stds: 1.5/1 twice, and sqrt(1.5^2 + 4^2) = 4.3.
        ((1.5, 0.0), (1.0, 1.0), (True, True, False)),
        # The same mean, narrow: 1.5/.5 = 3 twice; both are the nearest.
        ((1.5, 0.0), (0.5, 0.5), (True, True, False)),
        # Each dimension has its own std: 3/1 = 3 is too far, 4/2 = 2 is just within.
        ((0.0, 0.0), (1.0, 2.0), (True, False, True)),
        # Too far from all, 10/1, sqrt(49) = 7, sqrt(116) = 10.8: the nearest is still named.
        ((10.0, 0.0), (1.0, 1.0), (False, True, False)),
    ],
)
def test_plausible_classes_lie_within_two_standard_deviations(mean, std, expected):
    assert tuple(latent.plausible_classes(belief(mean, std), CLASS_MEANS)) == expected


def test_nearest_class_goes_by_the_mean_alone():
    # To (2, 1.9): sqrt(4 + 3.61) = 2.76, sqrt(1 + 3.61) = 2.15, sqrt(4 + 4.41) = 2.9.
    assert latent.nearest_class(belief((2.0, 1.9), (9.0, 0.1)), CLASS_MEANS) == 1


def test_moment_matching_error_of_the_matched_gaussian_is_zero():
    components = belief(((0.0, 1.0), (4.0, 2.0)), ((1.0, 0.5), (3.0, 0.7)))
    matched = Belief(*gaussian.moment_match(components.mean, components.std))
    np.testing.assert_allclose(latent.moment_matching_error(matched, components), 0.0, atol=1e-6)


def test_moment_matching_error_as_worked_by_hand():
    # The components match N(2, 3^2) and N(1, .5^2), see test_gaussian.
    # Dimension 1: |3.5 - 2| / 3 + |ln(6/3)| = .5 + .693147; dimension 2: |.9 - 1| / .5 + 0 = .2.
    components = belief(((0.0, 1.0), (4.0, 1.0)), ((1.0, 0.5), (3.0, 0.5)))
    error = latent.moment_matching_error(belief((3.5, 0.9), (6.0, 0.5)), components)
    np.testing.assert_allclose(error, (0.5 + 0.693147 + 0.2) / 2, rtol=1e-5)
    # Too narrow counts as much as too wide.
    narrow = latent.moment_matching_error(belief((0.5, 1.1), (1.5, 0.5)), components)
    np.testing.assert_allclose(narrow, error, rtol=1e-5)


def test_consistent_classes_share_a_label():
    # Colours of green cylinder, red cylinder, red cube.
    expected = [[True, False, False], [False, True, True], [False, True, True]]
    np.testing.assert_array_equal(latent.consistent_classes((1, 0, 0)), expected)
