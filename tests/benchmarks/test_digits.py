"""The comparison of JMVAEs on digits: its data, its classifier, its table, and all of it tiny."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import digits, peers
from benchmarks.digits import Budget
from jaxsense import vae

BUDGET = Budget(latent_size=4, hidden=(8,), steps=100, batch=64, learning_rate=1e-2)


@pytest.fixture(scope="module")
def data():
    """Three views, the first of which nobody needs, of 40 digits of each of 3 labels."""
    rng = np.random.default_rng(0)
    labels = np.repeat(np.arange(3), 40)
    centres = np.array([[3.0, 0.0], [0.0, 3.0], [-3.0, -3.0]])[labels]
    views = [centres @ rng.standard_normal((2, d)) + rng.normal(0, 0.5, (120, d)) for d in (4, 3)]
    return digits.split(("noise", "a", "b"), (rng.standard_normal((120, 2)), *views), labels)


def test_the_split_takes_three_quarters_of_each_label_and_scales_by_them(data):
    np.testing.assert_array_equal(np.bincount(data.train_labels), [30, 30, 30])
    np.testing.assert_array_equal(np.bincount(data.test_labels), [10, 10, 10])
    for x in data.train:
        np.testing.assert_allclose(x.mean(axis=0), 0.0, atol=1e-6)
        np.testing.assert_allclose(x.std(axis=0), 1.0, atol=1e-6)
    assert [x.shape for x in data.test] == [(30, 2), (30, 4), (30, 3)]
    assert not set(data.train[0][:, 0].tolist()) & set(data.test[0][:, 0].tolist())


def test_a_linear_classifier_by_hand():
    # Labels at -1 and 3, equally wide: what lies beyond 1 is nearer to 3. The second never varies.
    x = np.array([[-2.0, 5.0], [0.0, 5.0], [2.0, 5.0], [4.0, 5.0]])
    labels = digits.classifier(x, np.array([0, 0, 1, 1]))
    np.testing.assert_array_equal(labels(np.array([[0.9, 5.0], [1.1, 5.0]])), [0, 1])


def check(params, data):
    found = digits.figures(jax.random.key(0), params, data, BUDGET, samples=20)
    accuracies = [f"accuracy {name}" for name in ("all", *data.names)]
    assert [*found] == ["log-likelihood", *accuracies]
    # Two views show the label, the other does not; chance is 1/3.
    assert found["accuracy all"] > 0.8
    assert found["accuracy noise"] < 0.6
    # The best that a model that knows no connection can reach: N(0, 1) for each feature.
    assert found["log-likelihood"] > -0.5 * 9 * (1 + math.log(2 * math.pi))


@pytest.mark.slow  # compiles all measures
def test_figures_of_ours_at_tiny_size(data):
    check(digits.ours(data, BUDGET)(0), data)


@pytest.mark.slow  # imports PyTorch
def test_figures_of_multivae_are_those_of_its_networks(data):
    peer = peers.load("multivae")
    if peer is None:
        pytest.skip("multivae is not installed")
    check(peer.training(data, BUDGET)(0), data)
    model = BUDGET.model(data)
    theirs, names = peer.network(model), model.modalities
    params = jax.tree.map(jnp.asarray, peer.as_params(theirs, model))
    inputs = {name: peer.torch.tensor(x) for name, x in zip(names, data.test, strict=True)}
    for seen in ((1,), (0, 1, 2)):
        given = tuple(x if m in seen else None for m, x in enumerate(data.test))
        ours = jax.vmap(vae.encode, (None, None, 0))(params, model, given)[0]
        chosen = [names[m] for m in seen]
        batch = peer.MultimodalBaseDataset(inputs)
        found = theirs.encode(batch, cond_mod=chosen, return_mean=True).z.detach().numpy()
        np.testing.assert_allclose(ours, found, atol=1e-5)
