"""The filter: its algebra by hand, its learning against exact Bayes."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxsense.config import FilterConfig
from jaxsense.core.types import Belief
from jaxsense.vae import filtering, fusion, jmvae, peers
from jaxsense.vae.jmvae import Jmvae

# Red or green, cylinder or cube: classes are green cylinder, red cylinder, red cube.
MODEL = Jmvae(("camera", "lidar"), (2, 2), 2, (4,))
LABELS = np.array([[1, 0, 0], [0, 0, 1]])
CLASSES = Belief(jnp.array([[1.2, 0.9], [-0.8, 0.9], [-0.8, -1.3]]), jnp.full((3, 2), 0.4))
UNSEEN = fusion.unseen(MODEL, 20.0)


def exact():
    """A filter without hidden layers whose evidence is the logarithm of the label's feature."""
    params = filtering.init(jax.random.key(0), MODEL, CLASSES, UNSEEN, FilterConfig(hidden=(1,)))
    of_class = {
        name: {"params": {"Dense_0": {"kernel": jnp.eye(2)[:, labels], "bias": jnp.zeros(3)}}}
        for name, labels in zip(MODEL.modalities, LABELS, strict=True)
    }
    return {**params, "networks": of_class}


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


@given(st.lists(st.floats(0.001, 1.0), min_size=3, max_size=3))
@settings(max_examples=30, deadline=None)
def test_a_mixture_gives_back_its_weights(shares):
    shares = np.array(shares) / np.sum(shares)
    found = filtering.weights(exact(), filtering.mixture(CLASSES, jnp.array(shares, jnp.float32)))
    np.testing.assert_allclose(found, shares, atol=2e-5)


def test_a_mixture_has_the_moments_by_hand():
    found = filtering.mixture(CLASSES, jnp.array([0.5, 0.5, 0.0]))
    np.testing.assert_allclose(found.mean, [0.2, 0.9], atol=1e-6)
    np.testing.assert_allclose(found.std, [np.sqrt(0.16 + 1.0), 0.4], atol=1e-6)


@pytest.mark.parametrize("variance", [20.0, 1.0, 0.01])
def test_an_unseen_poi_may_be_of_any_class_however_wide_its_entry_is(variance):
    # Of the classes in the first dimension, 1.2^2 + .4^2 = 1.6 is the largest mean square.
    unseen = fusion.unseen(MODEL, variance)
    params = {**exact(), "unseen": unseen}
    np.testing.assert_allclose(filtering.weights(params, unseen), 1 / 3, atol=1e-6)
    rounded = Belief(unseen.mean, jnp.nextafter(unseen.std, 0.0))
    np.testing.assert_allclose(filtering.weights(params, rounded), 1 / 3, atol=1e-6)
    found = filtering.update(params, MODEL, unseen, jnp.array([0.8, 0.2]), 0)
    np.testing.assert_allclose(filtering.weights(params, found), [1 / 9, 4 / 9, 4 / 9], atol=1e-5)


def test_looks_by_hand():
    params = exact()
    red = filtering.update(params, MODEL, UNSEEN, jnp.array([0.8, 0.2]), 0)
    # .2 / 3 to .8 / 3 to .8 / 3.
    np.testing.assert_allclose(filtering.weights(params, red), [1 / 9, 4 / 9, 4 / 9], atol=1e-5)
    cube = filtering.update(params, MODEL, red, jnp.array([0.25, 0.75]), 1)
    # 1 * .25 to 4 * .25 to 4 * .75.
    expected = np.array([0.25, 1.0, 3.0]) / 4.25
    np.testing.assert_allclose(filtering.weights(params, cube), expected, atol=1e-5)
    again = filtering.update(params, MODEL, cube, jnp.array([0.25, 0.75]), 1)
    expected = np.array([0.25, 1.0, 9.0]) / 10.25
    np.testing.assert_allclose(filtering.weights(params, again), expected, atol=1e-5)


def test_looks_come_to_the_same_in_any_order():
    params = exact()
    looks = [(0, [0.7, 0.3]), (1, [0.4, 0.6]), (1, [0.8, 0.2]), (0, [0.9, 0.1])]

    def after(order):
        belief = UNSEEN
        for modality, features in order:
            belief = filtering.update(params, MODEL, belief, jnp.array(features), modality)
        return belief

    first, *others = (after(order) for order in itertools.permutations(looks))
    assert len(others) == 23
    for other in others:
        np.testing.assert_allclose(other.mean, first.mean, atol=1e-4)
        np.testing.assert_allclose(other.std, first.std, atol=1e-4)


def test_a_single_dimension_holds_three_classes():
    line = Belief(jnp.array([[-1.0, 0.0], [0.0, 0.0], [1.0, 0.0]]), jnp.full((3, 2), 0.3))
    params = {"inverse": filtering.moments_inverse(line), "unseen": UNSEEN}
    shares = jnp.array([0.2, 0.3, 0.5])
    found = filtering.weights(params, filtering.mixture(line, shares))
    np.testing.assert_allclose(found, shares, atol=1e-4)


@pytest.fixture(scope="module")
def trained():
    config = FilterConfig(hidden=(16,), steps=600, batch=128)
    params = filtering.init(jax.random.key(1), MODEL, CLASSES, UNSEEN, config)
    looks = bank(jax.random.key(2), 4000)

    @jax.jit
    def train(key, state):
        return filtering.train(key, state, params, MODEL, looks, config, 300)

    state, losses = filtering.start(params, config), []
    for i in range(2):
        state, loss = train(jax.random.key(3 + i), state)
        losses.append(loss)
    return {**params, "networks": state.params}, np.concatenate(losses)


def test_a_trained_filter_is_nearly_exact_bayes(trained):
    params, losses = trained
    assert losses[-50:].mean() < 0.7 * losses[:10].mean()
    looks = bank(jax.random.key(9), 2000)
    labels = jnp.array(LABELS)

    def history(true_class, row):
        belief, log_weights = UNSEEN, jnp.full(3, -jnp.log(3.0))
        for modality in (1, 0, 1, 1):
            features = looks[modality][true_class, row]
            belief = fusion.write(
                {"filter": params}, MODEL, belief, jnp.zeros(2, bool), features, modality
            )
            log_weights = peers.bayes_update(log_weights, features, labels[modality])
            row = row + 500
        return jnp.log(filtering.weights(params, belief)), log_weights

    every = jnp.arange(3), jnp.arange(500)
    found, expected = jax.jit(jax.vmap(jax.vmap(history, (None, 0)), (0, None)))(*every)
    nll, bayes = (-np.mean([x[c, :, c] for c in range(3)]) for x in (found, expected))
    assert nll == pytest.approx(bayes, rel=0.1)
    assert np.mean(np.abs(np.exp(found) - np.exp(expected))) < 0.01


def test_training_goes_on_where_it_stopped(trained):
    params, _ = trained
    config = FilterConfig(hidden=(16,), steps=600, batch=128)
    state = filtering.start(params, config)
    after, losses = jax.jit(
        lambda key, s: filtering.train(
            key, s, params, MODEL, bank(jax.random.key(2), 50), config, 3
        )
    )(jax.random.key(0), state)
    assert losses.shape == (3,)
    assert int(after.step) == 3
    assert jax.tree.structure(after.params) == jax.tree.structure(params["networks"])


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"modality": 2}, "modality = 2: must be a whole number from 0 to 1"),
        ({"features": jnp.array([0.5, 1.5])}, "features = 1.5: must be probabilities, within"),
        ({"features": jnp.array([0.5, jnp.nan])}, "features = nan: must be probabilities"),
        ({"features": jnp.array([0.5, 0.6])}, "sum of features = 1.1"),
        ({"belief": Belief(jnp.array([jnp.nan, 0.0]), jnp.ones(2))}, "belief.mean = nan"),
        ({"belief": Belief(jnp.zeros(2), jnp.array([1.0, 0.0]))}, "belief.std = 0.0: must be gr"),
        ({"belief": Belief(jnp.zeros(2), jnp.array([1.0, jnp.inf]))}, "belief.std = inf"),
    ],
)
def test_what_cannot_be_written_is_named(change, expected):
    given = {"belief": UNSEEN, "features": jnp.array([0.5, 0.5]), "modality": 0, **change}
    with pytest.raises(ValueError, match="^" + expected.replace(".", r"\.")):
        filtering.update(exact(), MODEL, **given)


def test_fusion_takes_the_filter_if_there_is_one():
    features, seen = jnp.array([0.9, 0.1]), jnp.array([True, False])
    params = jmvae.init(jax.random.key(0), MODEL)
    in_place = fusion.write(params, MODEL, UNSEEN, seen, features, 0)
    found = fusion.write({**params, "filter": exact()}, MODEL, UNSEEN, seen, features, 0)
    expected = filtering.update(exact(), MODEL, UNSEEN, features, 0)
    np.testing.assert_array_equal(found.mean, expected.mean)
    assert not np.allclose(found.mean, in_place.mean)


def test_entropy_by_hand():
    # (ln 2) / 2 + 2 (ln 4) / 4; a class without weight counts nothing.
    weights = jnp.array([[0.5, 0.25, 0.25], [0.0, 0.5, 0.5], [0.0, 1.0, 0.0]])
    expected = [1.5 * np.log(2), np.log(2), 0.0]
    np.testing.assert_allclose(filtering.entropy(weights), expected, atol=1e-6)


def test_likelihoods_of_classes_by_hand():
    # Of three classes one is green and two are red: .2 / (1/3) = .6 and .8 / (2/3) = 1.2.
    found = peers.log_likelihoods(jnp.array([0.8, 0.2]), LABELS[0])
    np.testing.assert_allclose(np.exp(found), [0.6, 1.2, 1.2], rtol=1e-6)
    # One cube and two cylinders; what the detector rules out keeps a chance of 1e-12.
    found = peers.log_likelihoods(jnp.array([1.0, 0.0]), LABELS[1])
    np.testing.assert_allclose(np.exp(found), [1.5, 1.5, 3e-12], rtol=1e-5)


def test_bayes_by_hand():
    # Two of three classes are red: .8 for red counts .8 / (2/3), and .2 for green .2 / (1/3).
    log_weights = peers.bayes_update(jnp.log(jnp.full(3, 1 / 3)), jnp.array([0.8, 0.2]), LABELS[0])
    np.testing.assert_allclose(np.exp(log_weights), [0.2, 0.4, 0.4], atol=1e-6)
    log_weights = peers.bayes_update(log_weights, jnp.array([0.0, 1.0]), LABELS[1])
    np.testing.assert_allclose(np.exp(log_weights), [0.0, 0.0, 1.0], atol=1e-6)


def test_product_of_experts_by_hand():
    of = lambda mean, std: Belief(jnp.array([mean]), jnp.array([std]))  # noqa: E731
    prior = of(0.0, 1.0)
    # Precisions 4 + 4 - 1 = 7, and (4 * 1 + 4 * 3 - 0) / 7.
    found = peers.product_of_experts(of(1.0, 0.5), of(3.0, 0.5), prior)
    np.testing.assert_allclose(found.mean, [16 / 7], rtol=1e-6)
    np.testing.assert_allclose(found.std, [7**-0.5], rtol=1e-6)
    # A look that knows nothing changes nothing.
    found = peers.product_of_experts(of(1.0, 0.5), prior, prior)
    np.testing.assert_allclose([found.mean[0], found.std[0]], [1.0, 0.5], rtol=1e-6)
