"""The filter: its algebra and exact Bayes by hand, its learning against exact Bayes."""

import dataclasses
import functools
import itertools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from exact_filter import LABELS, PRIOR, exact_filter, untrained_filter

from jaxsense.config.learning import FilterConfig
from jaxsense.core import supervised
from jaxsense.core.types import Belief
from jaxsense.vae import fusion, gaussian
from jaxsense.vae.readout import Bayes

NOBODY = np.zeros(2, bool)


@functools.partial(jax.jit, static_argnums=3)
def after_look(found, belief, features, modality):
    return found.update(belief, NOBODY, features, modality)


def update(found, belief, features, modality):
    return after_look(found, belief, np.float32(features), modality)


def bank(key, size):
    """Calibrated detections whose logits are Gaussian: camera right in .98, LiDAR in .93."""
    looks = []
    for k, labels, separation in zip(jax.random.split(key), LABELS, (2.05, 1.48), strict=True):
        sign = jnp.where(labels == 0, 1.0, -1.0)[:, None]
        x = jax.random.normal(k, (3, size)) + separation * sign
        prior = np.log(np.mean(labels == 0) / np.mean(labels == 1))
        first = jax.nn.sigmoid(2 * separation * x + prior)
        looks.append(jnp.stack([first, 1 - first], axis=-1))
    return tuple(looks)


def test_product_of_experts_by_hand():
    of = lambda mean, std: Belief(jnp.array([mean]), jnp.array([std]))  # noqa: E731
    prior = of(0.0, 1.0)
    # Precisions 4 + 4 - 1 = 7, and (4 * 1 + 4 * 3 - 0) / 7.
    found = gaussian.product_of_experts(of(1.0, 0.5), of(3.0, 0.5), prior)
    np.testing.assert_allclose(found.mean, [16 / 7], rtol=1e-6)
    np.testing.assert_allclose(found.std, [7**-0.5], rtol=1e-6)
    # A look that knows nothing changes nothing.
    found = gaussian.product_of_experts(of(1.0, 0.5), prior, prior)
    np.testing.assert_allclose([found.mean[0], found.std[0]], [1.0, 0.5], rtol=1e-6)
    # Two that are wider than the prior leave as good as nothing.
    found = gaussian.product_of_experts(of(0.0, 2.0), of(0.0, 2.0), prior)
    np.testing.assert_allclose(found.std, [1000.0], rtol=1e-6)
    # Of N(0, 1) and N(4, 9): (1 + 9) / 2 + 2^2 = 9.
    found = gaussian.moment_match(Belief(jnp.array([[0.0], [4.0]]), jnp.array([[1.0], [3.0]])))
    np.testing.assert_allclose([found.mean[0], found.std[0]], [2.0, 3.0], rtol=1e-6)


def test_looks_by_hand():
    found = exact_filter()
    read = jax.jit(found.class_probabilities)
    red = update(found, PRIOR, [0.8, 0.2], 0)
    # .2 / 3 to .8 / 3 to .8 / 3.
    np.testing.assert_allclose(read(red), [1 / 9, 4 / 9, 4 / 9], atol=1e-5)
    cube = update(found, red, [0.25, 0.75], 1)
    # 1 * .25 to 4 * .25 to 4 * .75.
    expected = np.array([0.25, 1.0, 3.0]) / 4.25
    np.testing.assert_allclose(read(cube), expected, atol=1e-5)
    again = update(found, cube, [0.25, 0.75], 1)
    expected = np.array([0.25, 1.0, 9.0]) / 10.25
    np.testing.assert_allclose(read(again), expected, atol=1e-5)


def test_looks_come_to_the_same_in_any_order_and_together():
    found = exact_filter()
    looks = [(0, [0.7, 0.3]), (1, [0.4, 0.6]), (1, [0.8, 0.2]), (0, [0.9, 0.1])]

    def after(order):
        belief = PRIOR
        for modality, features in order:
            belief = update(found, belief, features, modality)
        return belief

    first, *others = (after(order) for order in itertools.permutations(looks))
    assert len(others) == 23
    for other in others:
        np.testing.assert_allclose(other.mean, first.mean, atol=1e-4)
        np.testing.assert_allclose(other.std, first.std, atol=1e-4)
    together = jax.jit(found.together)({m: np.float32(x) for m, x in looks[:2]})
    chex.assert_trees_all_close(together, after(looks[:2]), rtol=1e-5)


EXACT = Bayes(jnp.array(LABELS))


def test_likelihoods_of_classes_by_hand():
    # Of three classes one is green and two are red: .2 / (1/3) = .6 and .8 / (2/3) = 1.2.
    found = EXACT.log_likelihoods(jnp.array([0.8, 0.2]), 0)
    np.testing.assert_allclose(np.exp(found), [0.6, 1.2, 1.2], rtol=1e-6)
    # One cube and two cylinders; what the detector rules out keeps a chance of 1e-12.
    found = EXACT.log_likelihoods(jnp.array([1.0, 0.0]), 1)
    np.testing.assert_allclose(np.exp(found), [1.5, 1.5, 3e-12], rtol=1e-5)


def test_looks_multiply_the_odds_of_classes():
    look = jnp.array([0.8, 0.2])
    np.testing.assert_allclose(np.exp(EXACT.prior), [1 / 3] * 3, rtol=1e-6)
    after = EXACT.update(EXACT.prior, look, 0)
    np.testing.assert_allclose(np.exp(after), [0.2, 0.4, 0.4], atol=1e-6)
    # Times .8 / (2/3), .8 / (2/3) and .2 / (1/3): .24, .48 and .24.
    after = EXACT.update(after, look, 1)
    np.testing.assert_allclose(np.exp(after), [0.25, 0.5, 0.25], atol=1e-6)


def test_histories_are_of_looks_at_their_classes_that_are_drawn_evenly():
    # Of each class two looks by each sensor; their second feature tells which one.
    of_class = np.stack([np.arange(3.0)] * 2, axis=1)
    looks = jnp.array(np.stack([of_class, [[0, 1]] * 3], axis=-1))
    problem = fusion.filtering(TRAINED, untrained_filter(), (looks, looks + 10))
    classes, sensors, found = jax.jit(problem.draw, static_argnums=1)(jax.random.key(0), 4)
    np.testing.assert_array_equal(np.unique(classes), range(3))
    np.testing.assert_array_equal(np.unique(sensors), range(2))
    for offset, of_sensor in zip((0, 10), found, strict=True):
        shown, row = np.moveaxis(of_sensor - offset, 1, 0)
        np.testing.assert_array_equal(shown, np.broadcast_to(classes[:, None], shown.shape))
        assert np.mean(row) == pytest.approx(0.5, abs=0.03)  # four deviations, of 6,144


TRAINED = FilterConfig(steps=600)


@pytest.fixture(scope="module")
def trained():
    """A filter after two chunks of half its training, and all losses."""
    found = untrained_filter((16,))
    problem = fusion.filtering(TRAINED, found, bank(jax.random.key(2), 4000))
    train = jax.jit(lambda key, state: supervised.fit(key, state, problem, 300))
    state, losses = supervised.start(found.networks, problem), []
    for i in range(2):
        state, loss = train(jax.random.key(3 + i), state)
        losses.append(loss)
    return dataclasses.replace(found, networks=state.params), np.concatenate(losses)


def test_a_trained_filter_is_nearly_exact_bayes(trained):
    learned, losses = trained
    assert losses[-50:].mean() < 0.7 * losses[:10].mean()
    looks = bank(jax.random.key(9), 2000)

    def history(true_class, row):
        belief, log_posterior = PRIOR, EXACT.prior
        for modality in (1, 0, 1, 1):
            features = looks[modality][true_class, row]
            belief = learned.update(belief, NOBODY, features, modality)
            log_posterior = EXACT.update(log_posterior, features, modality)
            row = row + 500
        return jnp.log(learned.class_probabilities(belief)), log_posterior

    every = jnp.arange(3), jnp.arange(500)
    found, expected = jax.jit(jax.vmap(jax.vmap(history, (None, 0)), (0, None)))(*every)
    nll, of_bayes = (-np.mean([x[c, :, c] for c in range(3)]) for x in (found, expected))
    assert nll == pytest.approx(of_bayes, rel=0.1)
    assert np.mean(np.abs(np.exp(found) - np.exp(expected))) < 0.01
