"""Detectors on windows whose answer is known: labels, "nothing there", and how sure they are."""

import functools
from dataclasses import replace
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsense.config import DetectorConfig
from jaxsense.core import supervised
from jaxsense.vae import detectors
from jaxsense.vae.detectors import Classifier, Looks

CONFIG = DetectorConfig(hidden=(16,), steps=400, batch=64, learning_rate=1e-2)
KEY = jax.random.key(0)
RAYS = 8
SHAPES = np.array([[0, 0, 0, 1, 1, 0, 0, 0], [0, 0, 1, 1, 1, 1, 0, 0]])
detect = jax.jit(detectors.detect)
detect_all = jax.jit(jax.vmap(detectors.detect, (None, 0, 0)))
features_of = jax.jit(jax.vmap(detectors.features, (None, 0, 0)))
retrain = jax.jit(detectors.retrain)


@functools.partial(jax.jit, static_argnums=(1, 2))
def some_looks(key, number, is_shown=True):
    """Ranges of 3 m, in which a PoI stands out by its width: where it is expected, or elsewhere."""
    distance_key, label_key, noise_key = jax.random.split(key, 3)
    distances = jax.random.uniform(distance_key, (number,), minval=0.5, maxval=2.0)
    labels = jax.random.randint(label_key, (number,), 0, 2)
    at = distances if is_shown else jnp.roll(distances, 1) + 0.5
    windows = jnp.where(jnp.array(SHAPES)[labels] == 1, at[:, None], 3.0)
    windows += 0.02 * jax.random.normal(noise_key, windows.shape)
    return Looks(windows, distances), labels


@pytest.fixture(scope="module")
def problem():
    shown, labels = some_looks(jax.random.key(1), 1000)
    nothing, _ = some_looks(jax.random.key(2), 500, False)
    init = lambda windows: detectors.init(KEY, windows, 2, CONFIG, measures_distance=True)  # noqa: E731
    untrained = jax.jit(init)(shown.windows)
    fit = detectors.problem(CONFIG, untrained, shown, labels, nothing)
    return SimpleNamespace(detector=untrained, shown=shown, nothing=nothing, fit=fit)


@pytest.fixture(scope="module")
def trained(problem):
    """A detector, and the losses of its training."""
    start = supervised.start(problem.detector.params, problem.fit)
    fit = jax.jit(lambda key, state: supervised.fit(key, state, problem.fit, CONFIG.steps))
    state, losses = fit(jax.random.key(2), start)
    found = replace(problem.detector, params=state.params)
    return jax.jit(detectors.fitted)(found, problem.shown, problem.nothing), losses


def linear(kernel, bias, threshold=-np.inf):
    """A detector without hidden layers, which reads the window, the distance and its inverse."""
    kernel, bias = np.float32(kernel), np.float32(bias)
    params = {"params": {"Dense_0": {"kernel": kernel, "bias": bias}}}
    size, scale = len(kernel) - 2, jnp.float32(1.0)
    threshold = jnp.float32(threshold)
    return Classifier(params, jnp.zeros(size), scale, threshold, False, (), len(bias) - 1)


def accuracy(detector, looks, labels):
    found = features_of(detector, looks.windows, looks.distances)
    return np.mean(found.argmax(axis=-1) == labels)


def test_a_trained_detector_tells_labels_apart_and_pois_from_nothing(problem, trained):
    detector, losses = trained
    (shown, labels), (nothing, _) = (
        some_looks(jax.random.key(3 + i), 2000, i == 0) for i in range(2)
    )
    assert accuracy(detector, shown, labels) >= 0.99
    assert accuracy(problem.detector, shown, labels) < 0.9
    assert losses[-20:].mean() < 0.1 * losses[:5].mean()
    found, of_nothing = (detect_all(detector, x.windows, x.distances) for x in (shown, nothing))
    assert found.is_there.mean() >= 0.97
    assert of_nothing.is_there.mean() <= 0.05
    np.testing.assert_allclose(found.features.sum(axis=1), 1.0, rtol=1e-5)


def test_one_distribution_holds_labels_and_nothing():
    # Odds of 3 to 1 for the first label, and of 4 to 1 that the PoI is there.
    found = detectors.log_probabilities(jnp.log(jnp.array([3.0, 1.0, 4.0])))
    np.testing.assert_allclose(np.exp(found), [0.6, 0.2, 0.2], rtol=1e-5)
    found = detectors.log_probabilities(jnp.array([[0.0], [0.0], [-80.0]]))
    np.testing.assert_allclose(found[:, 0], [-80 - np.log(2), -80 - np.log(2), 0], atol=1e-4)


def test_the_loss_is_the_mean_cross_entropy_of_both_kinds_of_looks():
    # Labels as likely as one another; the log-odds that a PoI is there are its distance.
    detector = linear([[0, 0, 0], [0, 0, 1], [0, 0, 0]], [0, 0, 0])
    looks = lambda *at: Looks(jnp.zeros((len(at), 1)), jnp.array(at))  # noqa: E731
    problem = detectors.problem(CONFIG, detector, looks(2.0, 0.5), jnp.array([0, 1]), looks(1.0))
    rows, of_nothing = problem.draw(KEY, 4)
    np.testing.assert_array_equal(np.unique(rows), [0, 1])
    assert (rows.shape, of_nothing.shape) == ((4, 64), (4, 32))
    drawn = jnp.array([0, 1]), jnp.array([0])
    # -log sigmoid(2) = .126928, -log sigmoid(.5) = .474077, log 2 for the label; and
    # -log(1 - sigmoid(1)) = 1.313262.
    expected = (0.126928 + 0.474077) / 2 + np.log(2) + 1.313262
    found = jax.jit(problem.loss)(detector.params, drawn, jnp.int32(0))
    np.testing.assert_allclose(found, expected, rtol=1e-5)


def scored(scores):
    return Looks(jnp.zeros((len(scores), 1)), jnp.asarray(scores, jnp.float32))


def test_a_threshold_loses_one_look_in_a_hundred_and_no_more_than_needed():
    detector = linear([[0, 0, 0], [0, 0, 1], [0, 0, 0]], [0, 0, 0])
    scores = np.linspace(1.0, 1001.0, 1001)  # of looks at PoIs: 1 % of them are below 11
    fitted = jax.jit(detectors.fitted)
    # 0.2 % of the looks at nothing are above 5.99 of 0 to 6.
    for nothing, expected in ((scores + 5.0, 11.0), (np.linspace(1e-3, 6.0, 1001), 0.998 * 6.0)):
        found = fitted(detector, scored(scores), scored(nothing))
        factor = found.params["params"]["Dense_0"]["kernel"][1, 2]
        assert found.threshold / factor == pytest.approx(expected, rel=1e-3)


def test_odds_are_those_of_looks_that_training_did_not_use():
    rng, true = np.random.default_rng(0), np.float32(0.5)
    scores = rng.uniform(0.01, 4.0, 20_000)
    is_shown = rng.uniform(size=len(scores)) < 1 / (1 + np.exp(-true * (scores - 2)))
    detector = linear([[0, 0, 0], [0, 0, 1], [0, 0, 0]], [0, 0, -2])
    found = jax.jit(detectors.fitted)(detector, scored(scores[is_shown]), scored(scores[~is_shown]))
    last = found.params["params"]["Dense_0"]
    np.testing.assert_allclose(last["kernel"][1, 2], true, rtol=0.06)
    np.testing.assert_allclose(last["bias"], [0, 0, -2 * last["kernel"][1, 2]], rtol=1e-5)


@pytest.mark.parametrize(
    ("reading", "distance", "is_known"),
    [
        (1.0, 1.0, True), (np.nan, 1.0, False), (-np.inf, 1.0, False), (1.0, np.nan, False),
        (1.0, np.inf, False), (1.0, 0.0, False), (1.0, -1.0, False),
    ],
)  # fmt: skip
def test_an_untrained_detector_answers_what_is_valid(problem, reading, distance, is_known):
    window = np.ones(RAYS, np.float32)
    window[2] = reading
    found = detect(problem.detector, window, np.float32(distance))
    assert (found.is_known, found.is_there) == (is_known, is_known)
    assert is_known or found.features.tolist() == [0.5, 0.5]


def test_below_its_threshold_a_look_shows_nothing():
    # Log-odds are the distance, and the first label is nine times as likely.
    kernel = [[0, 0, 0], [0, 0, 1], [0, 0, 0]]
    detector = linear(kernel, [np.log(9), 0, 0], threshold=0.8)
    for distance, features in ((0.79, [0.5, 0.5]), (0.81, [0.9, 0.1])):
        found = detect(detector, jnp.zeros(1), jnp.float32(distance))
        assert found.is_known
        assert found.is_there == (distance > 0.8)
        np.testing.assert_allclose(found.features, features, rtol=1e-5)
        given = detectors.features(detector, jnp.zeros(1), jnp.float32(distance))
        np.testing.assert_allclose(given, [0.9, 0.1], rtol=1e-5)


def test_a_detector_of_ranges_reads_how_far_they_are_from_the_poi(problem):
    # Without what reads ranges and the expected distance themselves.
    weights = jax.tree.map(np.array, problem.detector.params)
    first = weights["params"]["Dense_0"]["kernel"]
    first[:RAYS] = first[2 * RAYS :] = 0.0
    of_range = replace(problem.detector, params=weights)
    window = np.linspace(0.9, 1.1, RAYS, dtype=np.float32)
    read = jax.jit(Classifier.logits)
    near = read(of_range, window, np.float32(1.0))
    np.testing.assert_allclose(read(of_range, window + 0.5, np.float32(1.5)), near, atol=1e-5)
    assert np.abs(read(of_range, window + 0.1, np.float32(1.0)) - near).max() > 1e-3
    # Beyond half a metre it makes no difference how far.
    far, farther = (read(of_range, window + x, np.float32(1.0)) for x in (2.0, 3.0))
    np.testing.assert_allclose(far, farther, atol=1e-5)


@pytest.mark.parametrize(
    ("temperature", "left", "error"),
    # 513 temperatures from 1/16 to 16 are steps of 16^(1/256) = 1.0109: half of one away at most.
    # Beyond 16 some of it is left.
    [(0.25, 1.0, 1e-5), (1.0, 1.0, 1e-5), (3.0, 1.0, 0.0055), (32.0, 2.0, 1e-5)],
)
def test_calibration_finds_the_temperature_of_the_labels(temperature, left, error):
    # Of ten looks that are all the same eight are of label 0: logits should be ln(8 / 2) apart.
    right, labels = np.log(4.0), jnp.array([0] * 8 + [1] * 2)
    half = np.array([0.5 + temperature * right, 0.5, 1.0]) / 2
    detector = linear([half, [0, 0, 0], [0, 0, 0]], half)
    looks = Looks(jnp.ones((10, 1)), jnp.ones(10))
    calibrated = jax.jit(detectors.calibrate)(detector, looks, labels)
    found = calibrated.of(looks)[:, 0]
    assert found[0] - found[1] == pytest.approx(left * right, rel=error)
    np.testing.assert_allclose(found[-1], 1.0, rtol=1e-5)


# The first reading is the log-odds of a window, less the distance beyond 1 m; the second is the
# logit of a label.
READ = [[0, 0, 1], [1, 0, 0], [0, 0, -1], [0, 0, 0]]
search = jax.jit(detectors.search)


def test_a_search_pools_the_windows_by_their_posterior_odds():
    detector = linear(READ, [0, 0, 1], threshold=1.5)
    windows = jnp.array([[2.0, 3.0], [2.0, -1.0], [9.0, 5.0], [np.nan, 5.0]])
    prior = jnp.array([0.0, -np.log(3.0), -np.inf, 0.0])
    found = search(detector, windows, jnp.array([1.0]), prior[None])
    # Shares 3/4 and 1/4: a logit of 3 x .75 - 1 x .25 = 2, and the sigmoid of 2 is .8808.
    assert found.is_there
    np.testing.assert_allclose(found.features, [0.8808, 0.1192], atol=1e-3)
    # Log-odds of 2 and, at the other distance, of 2 - x: a mean of 2 - log 2 + log(1 + e^-x), which
    # is 1.5 for x = 1.55. A distance that is not positive is none, and has no share in the mean.
    for distances, is_there in (
        *(([1.0, 2.5], True), ([1.0, 2.6], False), ([1.0, -1.0], True), ([1.0, np.nan], True)),
        ([-1.0, np.nan], False),
    ):
        found = search(detector, windows, jnp.array(distances), jnp.tile(prior, (2, 1)))
        assert bool(found.is_there) is is_there
        assert is_there or found.features.tolist() == [0.5, 0.5]
    assert not search(detector, windows, jnp.ones(1), jnp.full((1, 4), -jnp.inf)).is_there


def test_few_looks_teach_an_offset_and_keep_what_was_learned(trained):
    detector = trained[0]
    (few, labels), (others, of_others) = (some_looks(jax.random.key(5 + i), 200) for i in range(2))
    # Where there is nothing to learn, nothing is forgotten.
    same = retrain(jax.random.key(7), detector, few, labels)
    assert accuracy(same, others, of_others) > accuracy(detector, others, of_others) - 0.005
    # Readings that are all too low.
    spoil = lambda looks: replace(looks, windows=looks.windows - 0.6)  # noqa: E731
    assert accuracy(detector, spoil(others), of_others) < 0.9
    config = replace(CONFIG, calibration=0.25)
    moved = jax.jit(detectors.retrain)(jax.random.key(7), detector, spoil(few), labels, config)
    assert accuracy(moved, spoil(others), of_others) > 0.97
    np.testing.assert_array_equal(detector.of(others)[-1], moved.of(others)[-1])
    # Three quarters of the labels are wrong: those that are kept tell that this helps nothing.
    wrong = jnp.where(jnp.arange(200) < 150, 1 - labels, labels)
    same = retrain(jax.random.key(7), detector, few, wrong)
    jax.tree.map(np.testing.assert_array_equal, same.params, detector.params)
