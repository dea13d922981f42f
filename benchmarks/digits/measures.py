"""What is measured of a trained model, the same for all."""

import dataclasses
import itertools
from collections.abc import Iterator

import numpy as np
from scipy.special import logsumexp

from benchmarks.digits.data import Digits, Views
from benchmarks.digits.models import Budget, Run, Subset, Trained

_ROWS = 20  # digits whose importance samples are decoded together
_RIDGE = 1e-3

Figures = dict[str, float]
"""What is measured of one training, by name."""


@dataclasses.dataclass(frozen=True)
class Linear:
    """A linear discriminant analysis: equally frequent labels, one covariance for all.

    Attributes:
      weights: `[F, C]`.
      offsets: `[C]`.
    """

    weights: np.ndarray
    offsets: np.ndarray

    def accuracy(self, x: np.ndarray, labels: np.ndarray) -> float:
        """Share of right labels.

        Args:
          x: `[N, F]` features.
          labels: `[N]` the right labels.
        """
        return float(np.mean((x @ self.weights + self.offsets).argmax(axis=1) == labels))


def fit(x: np.ndarray, labels: np.ndarray) -> Linear:
    """The classifier of some features.

    Args:
      x: `[N, F]` features.
      labels: `[N]` from 0 to C - 1.
    """
    x = x.astype(np.float64)
    means = np.stack([x[labels == label].mean(axis=0) for label in range(labels.max() + 1)])
    within = x - means[labels]
    covariance = within.T @ within / len(x)
    # Features that never vary, such as unused latents, leave it singular.
    covariance += _RIDGE * np.trace(covariance) / len(covariance) * np.eye(len(covariance))
    weights = np.linalg.solve(covariance, means.T)
    return Linear(weights, -0.5 * np.sum(means.T * weights, axis=0))


def log_likelihood(
    rng: np.random.Generator, trained: Trained, views: Views, variance: float, samples: int
) -> np.ndarray:
    """Estimates `log p(all views)` by importance sampling with the joint posterior.

    Args:
      rng: of the samples.
      trained: the model.
      views: all views of N digits.
      variance: of each feature given z.
      samples: of z for each digit.

    Returns:
      `[N]` in nats.
    """
    means, log_variances = trained.joint(views)
    found = [
        _of_rows(
            rng,
            trained,
            tuple(x[i : i + _ROWS] for x in views),
            (means[:, i : i + _ROWS], log_variances[:, i : i + _ROWS]),
            variance,
            samples,
        )
        for i in range(0, means.shape[1], _ROWS)
    ]
    return np.concatenate(found)


def _of_rows(
    rng: np.random.Generator,
    trained: Trained,
    views: Views,
    joint: tuple[np.ndarray, np.ndarray],
    variance: float,
    samples: int,
) -> np.ndarray:
    number, rows, size = joint[0].shape
    chosen, row = rng.integers(number, size=(rows, samples)), np.arange(rows)[:, None]
    mean, log_variance = (x[chosen, row] for x in joint)  # [N, K, D]
    z = mean + np.exp(0.5 * log_variance) * rng.standard_normal(mean.shape, np.float32)
    log_weights = _log_standard_normal(z) - log_mixture(z, *joint)
    decoded = trained.decode(z.reshape(-1, size).astype(np.float32))
    for x, of_view in zip(views, decoded, strict=True):
        error = of_view.reshape(rows, samples, -1) - x[:, None]
        log_weights -= 0.5 * np.einsum("nkf,nkf->nk", error, error) / variance
        log_weights -= 0.5 * x.shape[1] * np.log(2 * np.pi * variance)
    return logsumexp(log_weights, axis=1) - np.log(samples)


def _log_standard_normal(z: np.ndarray) -> np.ndarray:
    return -0.5 * np.sum(z.astype(np.float64) ** 2 + np.log(2 * np.pi), axis=-1)


def log_mixture(z: np.ndarray, means: np.ndarray, log_variances: np.ndarray) -> np.ndarray:
    """Log-density of equal mixtures of Gaussians.

    Args:
      z: `[N, K, D]` points.
      means: `[J, N, D]`.
      log_variances: `[J, N, D]`.

    Returns:
      `[N, K]`.
    """
    z, means, log_variances = (x.astype(np.float64) for x in (z, means, log_variances))
    precisions = np.exp(-log_variances)
    # |z - m|^2 / v as a product of matrices: with all differences, mixtures of 63 take minutes.
    squares = np.einsum("nkd,jnd->nkj", z**2, precisions, optimize=True)
    squares -= 2 * np.einsum("nkd,jnd->nkj", z, precisions * means, optimize=True)
    constants = np.sum(precisions * means**2 + log_variances + np.log(2 * np.pi), axis=-1)
    of_each = -0.5 * (squares + constants.T[:, None])
    return logsumexp(of_each, axis=2) - np.log(len(means))


def measure(run: Run, digits: Digits, budget: Budget, samples: int, seed: int) -> Figures:
    """All figures of one training.

    Args:
      run: the training.
      digits: the data.
      budget: settings.
      samples: for the log-likelihood of each digit.
      seed: of these samples.
    """
    rng = np.random.default_rng(seed)
    likelihoods = log_likelihood(rng, run.trained, digits.test, budget.variance, samples)
    return {
        "log-likelihood": float(likelihoods.mean()),
        **_accuracies(run.trained, digits),
        "coherence": _coherence(run.trained, digits),
        "seconds": run.seconds,
        "seconds compiling": run.compiling,
    }


def _accuracies(trained: Trained, digits: Digits) -> Figures:
    number = len(digits.names)
    every = tuple(range(number))
    classifier = fit(trained.means(digits.train, every), digits.train_labels)
    found = {
        seen: classifier.accuracy(trained.means(digits.test, seen), digits.test_labels)
        for seen in _subsets(number)
    }
    of_size = {k: [x for seen, x in found.items() if len(seen) == k] for k in range(1, number)}
    return {
        "accuracy all": found[every],
        **{f"accuracy {name}": found[m,] for m, name in enumerate(digits.names)},
        **{
            f"accuracy, {number - k} missing": float(np.mean(of_size[k]))
            for k in reversed(range(1, number))
        },
    }


def _subsets(number: int) -> Iterator[Subset]:
    for size in range(1, number + 1):
        yield from itertools.combinations(range(number), size)


def _coherence(trained: Trained, digits: Digits) -> float:
    classifiers = [fit(x, digits.train_labels) for x in digits.train]
    found = []
    for m in range(len(digits.names)):
        decoded = trained.decode(trained.sample(digits.test, (m,)))
        found += [
            classifier.accuracy(decoded[other], digits.test_labels)
            for other, classifier in enumerate(classifiers)
            if other != m
        ]
    return float(np.mean(found))


def of_true_views(digits: Digits) -> Figures:
    """Accuracy of the classifiers of true views, by view: what coherence could reach.

    Args:
      digits: the data.
    """
    return {
        name: fit(x, digits.train_labels).accuracy(y, digits.test_labels)
        for name, x, y in zip(digits.names, digits.train, digits.test, strict=True)
    }
