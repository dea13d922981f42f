"""Class probabilities in a belief, and the classes that it leaves open, by hand."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from exact_filter import CLASSES, MODEL, PRIOR

from jaxsense.core.types import Belief
from jaxsense.vae import fusion, readout

READ = readout.make(CLASSES)


@jax.jit
def read(belief, prior=PRIOR):
    return READ.class_probabilities(belief, prior)


mixture = jax.jit(readout.mixture)


def test_a_mixture_has_the_moments_by_hand():
    found = mixture(CLASSES, jnp.array([0.5, 0.5, 0.0]))
    np.testing.assert_allclose(found.mean, [0.2, 0.9], atol=1e-6)
    np.testing.assert_allclose(found.std, [np.sqrt(0.16 + 1.0), 0.4], atol=1e-6)
    np.testing.assert_allclose(readout.sigma_norm(jnp.array([[3.0, 4.0], [6.0, 8.0]])), [5, 10])


@pytest.mark.parametrize("variance", [20.0, 0.01])
def test_a_prior_may_be_of_any_class_however_wide_it_is(variance):
    # Of the classes in the first dimension, 1.2^2 + .4^2 = 1.6 is the largest mean square.
    prior = fusion.prior(MODEL, variance)
    np.testing.assert_allclose(read(prior, prior), 1 / 3, atol=1e-6)
    rounded = Belief(prior.mean, jnp.nextafter(prior.std, 0.0))
    np.testing.assert_allclose(read(rounded, prior), 1 / 3, atol=1e-6)


def test_labels_leave_as_many_directions_as_they_have_less_one_each():
    rng = np.random.default_rng(0)
    classes = Belief(jnp.array(rng.normal(size=(6, 5))), jnp.array(rng.uniform(0.2, 0.6, (6, 5))))
    directions = lambda *numbers: readout.make(classes, numbers or None).whitening.shape[1]  # noqa: E731
    assert [directions(), directions(3, 2), directions(2), directions(9)] == [5, 3, 1, 5]


def test_a_belief_that_is_only_near_the_prior_is_read_by_its_moments():
    # A prior with the moments of a mixture of 1 to 4 to 4, which it would read as if it were one.
    shares = np.array([1, 4, 4]) / 9
    prior = mixture(CLASSES, jnp.array(shares, jnp.float32))
    np.testing.assert_allclose(read(prior, prior), 1 / 3, atol=1e-6)
    step = 1e-3 * prior.std
    for near in (Belief(prior.mean + step, prior.std), Belief(prior.mean, prior.std + step)):
        np.testing.assert_allclose(read(near, prior), shares, atol=0.01)


def test_a_belief_that_is_nearly_certain_is_read_by_its_moments():
    # Between two classes that are close, too long a step would choose one for good.
    line = Belief(jnp.array([[-2.0], [0.5], [0.7], [2.0]]), jnp.full((4, 1), 0.3))
    held = mixture(line, jnp.array([0.01, 0.01, 0.97, 0.01]))
    prior = Belief(jnp.zeros(1), jnp.full(1, 4.5))
    found = mixture(line, jax.jit(readout.make(line).class_probabilities)(held, prior))
    np.testing.assert_allclose([*found.mean, *found.std], [*held.mean, *held.std], rtol=1e-4)


@functools.cache
def held_and_read(prototypes):
    """Class probabilities as they are read from a belief that holds others, by classes' means."""
    mean = np.array(prototypes, np.float32)

    @jax.jit
    def back(probabilities):
        classes = Belief(jnp.array(mean), jnp.full(mean.shape, 0.3))
        prior = Belief(jnp.zeros(mean.shape[1]), jnp.full(mean.shape[1], 4.5))
        found = readout.make(classes)
        return jax.vmap(lambda p: found.class_probabilities(readout.mixture(classes, p), prior))(
            probabilities
        )

    return back


def looked_at(labels, prototypes, looks):
    """NLL of the true class by the map and by exact Bayes, after looks by the sensors in turn."""
    rng, number, histories = np.random.default_rng(0), len(prototypes), 2000
    back = held_and_read(tuple(map(tuple, prototypes)))
    truth, exact = rng.integers(number, size=histories), np.zeros((histories, number))
    known = back(np.full((histories, number), 1 / number, np.float32))
    for look in range(looks):
        of_class = np.array(labels[look % len(labels)])
        quality = rng.uniform(0.3, 4.0, size=(histories, 1))
        logits = np.sqrt(quality) * rng.normal(size=(histories, of_class.max() + 1))
        logits += quality * np.eye(logits.shape[1])[of_class[truth]]
        exact += logits[:, of_class]
        weights = np.asarray(known) * np.exp(logits[:, of_class])
        known = back(np.float32(weights / weights.sum(axis=1, keepdims=True)))
    right = np.arange(histories), truth
    weights = np.exp(exact)
    of_bayes = weights / weights.sum(axis=1, keepdims=True)
    return [-float(np.mean(np.log(np.asarray(x))[right])) for x in (known, of_bayes)]


SQUARE = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
GRID = [(a, b) for a in range(4) for b in range(4)]
WORLDS = {
    "5 of 3x2": (
        [[0, 0, 1, 1, 2], [0, 1, 0, 1, 0]],
        [[m, n] for m in (-1.1, 0.0, 1.1) for n in (-0.8, 0.8)][:5],
    ),
    "4x4": (
        [[a for a, _ in GRID], [b for _, b in GRID]],
        [[*SQUARE[a], *SQUARE[b]] for a, b in GRID],
    ),
}


@pytest.mark.parametrize("world", WORLDS)
def test_a_map_knows_what_exact_bayes_knows(world):
    labels, prototypes = WORLDS[world]
    of_map, of_bayes = looked_at(labels, prototypes, 6)
    assert of_map - of_bayes < 0.003
    assert of_map == pytest.approx(of_bayes, rel=0.02)


def test_a_divergence_as_worked_by_hand():
    # .75 ln(.75 / .5) + .25 ln(.25 / .5)
    expected = 0.75 * np.log(1.5) - 0.25 * np.log(2.0)
    found = readout.divergence(jnp.array([0.75, 0.25, 0.0]), jnp.array([0.5, 0.5, 1e-6]))
    np.testing.assert_allclose(found, expected, rtol=1e-6)


CLASS_MEANS = jnp.array([[0.0, 0.0], [3.0, 0.0], [0.0, 4.0]])


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
    assert (
        tuple(readout.plausible_classes(Belief(jnp.array(mean), jnp.array(std)), CLASS_MEANS))
        == expected
    )
