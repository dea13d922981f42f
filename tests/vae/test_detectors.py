"""Detectors on synthetic windows."""

import functools
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsense.config import DetectorConfig
from jaxsense.core import supervised
from jaxsense.vae import calibration, detectors

CONFIG = DetectorConfig(hidden=(16,), steps=200, batch=64, learning_rate=1e-2)


calibrate = jax.jit(detectors.calibrate)
detect = jax.jit(jax.vmap(detectors.detect, in_axes=(None, 0)))
logits_of = jax.jit(jax.vmap(detectors.logits, in_axes=(None, 0)))
retrain = jax.jit(detectors.retrain)


@functools.partial(jax.jit, static_argnums=1)
def synthetic_windows(key, number):
    """Windows of 6 readings around 5: the label says whether the middle two stand out."""
    label_key, noise_key = jax.random.split(key)
    labels = jax.random.randint(label_key, (number,), 0, 2)
    bump = jnp.array([0.0, 0.0, 1.0, 1.0, 0.0, 0.0])
    noise = 0.2 * jax.random.normal(noise_key, (number, 6))
    return 5.0 + labels[:, None] * bump[None] + noise, labels


def accuracy(detector, windows, labels):
    features = detect(detector, windows)
    return np.mean(features.argmax(axis=-1) == labels)


def fit(detector, windows, labels, config):
    problem = detectors.Fitting(config, detector, windows, labels)
    state = supervised.start(detector.params, config)
    train = jax.jit(lambda key, state: supervised.fit(key, state, problem, config.steps))
    return train(jax.random.key(2), state)


@pytest.fixture(scope="module")
def trained():
    windows, labels = synthetic_windows(jax.random.key(0), 1000)
    detector = detectors.init(jax.random.key(1), windows, 2, CONFIG)
    state, losses = fit(detector, windows, labels, CONFIG)
    return detector, replace(detector, params=state.params), losses


def test_training_learns_a_separable_set(trained):
    untrained, detector, losses = trained
    windows, labels = synthetic_windows(jax.random.key(3), 1000)
    assert accuracy(detector, windows, labels) >= 0.99
    assert accuracy(untrained, windows, labels) < 0.9
    assert losses.shape == (200,)
    assert losses[-20:].mean() < 0.1 * losses[:5].mean()


def test_detect_gives_probabilities_of_the_labels_in_order(trained):
    _, detector, _ = trained
    windows, labels = synthetic_windows(jax.random.key(4), 50)
    features = detect(detector, windows)
    assert features.shape == (50, 2)
    np.testing.assert_allclose(features.sum(axis=-1), 1.0, rtol=1e-6)
    np.testing.assert_array_equal(features[:, 1] > 0.5, labels == 1)


def with_logits(*logits):
    """A detector of these logits for every window, half by its last bias and half by its kernel."""
    detector = detectors.init(jax.random.key(0), jnp.zeros((2, 3)), len(logits), CONFIG)
    layers = jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), detector.params["params"])
    half = np.float32(logits) / 2
    layers["Dense_0"]["bias"][0] = 1.0
    layers["Dense_1"]["kernel"][0] = layers["Dense_1"]["bias"][:] = half
    return replace(detector, params={"params": layers})


@pytest.mark.parametrize(
    ("temperature", "left", "error"),
    [
        (0.25, 1.0, 1e-5),
        (0.5, 1.0, 1e-5),
        (1.0, 1.0, 1e-5),
        (2.0, 1.0, 1e-5),
        (4.0, 1.0, 1e-5),
        # 257 temperatures from 1/4 to 4 are steps of 16^(1/256) = 1.0109: half of one away at most.
        (3.0, 1.0, 0.0055),
        (0.7, 1.0, 0.0055),
        # Beyond 4 and 1/4 some of it is left.
        (8.0, 2.0, 1e-5),
        (0.1, 0.4, 1e-5),
    ],
)
def test_calibration_finds_the_temperature_of_the_logits(temperature, left, error):
    # Of ten looks that are all the same eight are of label 0: logits should be ln(8 / 2) apart.
    right, labels = np.log(4.0), jnp.array([0] * 8 + [1] * 2)
    detector = with_logits(0.5 + temperature * right, 0.5)
    calibrated = calibrate(detector, jnp.zeros((10, 3)), labels)
    logits = logits_of(calibrated, jnp.zeros((1, 3)))[0]
    assert logits[0] - logits[1] == pytest.approx(left * right, rel=error)


def test_calibration_reads_windows_as_the_detector_does(trained):
    # Labels are drawn by its own logits, and by flatter and sharper ones.
    _, detector, _ = trained
    windows, _ = synthetic_windows(jax.random.key(5), 4000)
    logits = logits_of(detector, windows)
    is_unsure = jnp.abs(logits[:, 0] - logits[:, 1]) < 4
    unsure, logits = windows[is_unsure], logits[is_unsure]
    for sharpness in (0.5, 1.0, 2.0):
        labels = jax.random.categorical(jax.random.key(6), sharpness * logits)
        calibrated = calibrate(detector, unsure, labels)
        found = logits_of(calibrated, unsure)
        ratio = np.sum(found * logits) / np.sum(logits**2)
        np.testing.assert_allclose(found, ratio * logits, atol=1e-4)
        # Four standard errors of the most likely sharpness, and a step of the search.
        apart = np.asarray(logits[:, 0] - logits[:, 1])
        spread = 1 / (2 + 2 * np.cosh(sharpness * apart))  # p (1 - p) of each label
        error = 4 / np.sqrt(np.sum(spread * apart**2)) + 0.011 * sharpness
        np.testing.assert_allclose(ratio, sharpness, atol=error)


def test_calibration_changes_no_label_and_never_makes_the_looks_less_likely(trained):
    _, detector, _ = trained
    of_one, labels = synthetic_windows(jax.random.key(7), 300)
    # Half way between the labels, where the detector is unsure.
    windows = (of_one + of_one[::-1]) / 2
    for given in (labels, 1 - labels, jnp.zeros(300, int)):
        calibrated = calibrate(detector, windows, given)
        before, after = (detect(d, windows) for d in (detector, calibrated))
        np.testing.assert_array_equal(before.argmax(axis=1), after.argmax(axis=1))
        nll_before, nll_after = (
            calibration.negative_log_likelihood(p, given) for p in (before, after)
        )
        assert nll_after <= nll_before + 1e-6


def test_a_training_starts_from_the_loss_of_the_detector_it_is_given():
    windows, labels = synthetic_windows(jax.random.key(0), 1000)
    detector = detectors.init(jax.random.key(1), windows, 2, CONFIG)
    config = replace(CONFIG, steps=20, batch=256, learning_rate=1e-12)
    _, losses = fit(detector, windows, labels, config)
    assert len(np.unique(losses)) == 20  # every step draws anew
    each = detect(detector, windows)
    expected = -np.log(np.asarray(each)[np.arange(1000), labels])
    error = expected.std() / np.sqrt(20 * 256)
    np.testing.assert_allclose(losses.mean(), expected.mean(), atol=4 * error)


def test_init_standardises_the_readings():
    windows = jnp.array([[1.0, 10.0], [3.0, 14.0]])
    detector = detectors.init(jax.random.key(0), windows, 2, CONFIG)
    np.testing.assert_allclose(detector.offset, [2.0, 12.0])  # the mean of each reading
    # Deviations -1, 1, -2, 2: one scale for all of them, sqrt((1 + 1 + 4 + 4) / 4) = 1.581139.
    np.testing.assert_allclose(detector.scale, 1.581139, rtol=1e-5)


def test_logits_do_not_depend_on_the_unit_of_the_readings():
    windows, _ = synthetic_windows(jax.random.key(0), 100)
    key = jax.random.key(1)
    in_metres = detectors.init(key, windows, 2, CONFIG)
    in_millimetres = detectors.init(key, 1000.0 * windows + 300.0, 2, CONFIG)
    np.testing.assert_allclose(
        logits_of(in_metres, windows[:3]),
        logits_of(in_millimetres, 1000.0 * windows[:3] + 300.0),
        atol=1e-3,
    )


def test_a_window_of_the_wrong_shape_raises_an_error_that_names_it(trained):
    _, detector, _ = trained
    with pytest.raises(ValueError, match="window"):
        detectors.detect(detector, jnp.zeros(5))
    with pytest.raises(ValueError, match="windows"):
        detectors.init(jax.random.key(0), jnp.zeros(5), 2, CONFIG)


def test_few_windows_teach_an_offset_and_keep_what_was_learned(trained):
    detector = trained[1]
    windows, labels = synthetic_windows(jax.random.key(5), 200)
    others, of_others = synthetic_windows(jax.random.key(6), 2000)
    before = accuracy(detector, others, of_others)
    assert before > 0.99
    # Where there is nothing to learn, nothing is forgotten.
    same = retrain(jax.random.key(7), detector, windows, labels)
    assert accuracy(same, others, of_others) > before - 0.005
    # Readings that are all too low by more than half of what tells the labels.
    offset = 0.7
    assert accuracy(detector, others - offset, of_others) < 0.95
    config = replace(CONFIG, calibration=0.25)
    moved = jax.jit(detectors.retrain)(
        jax.random.key(7), detector, windows - offset, labels, config
    )
    assert accuracy(moved, others - offset, of_others) > 0.99
    jax.tree.map(np.testing.assert_array_equal, moved.gate, detector.gate)


def test_retraining_moves_no_farther_than_serves_windows_kept_from_it(trained):
    # The last quarter of the windows is kept. Labels that are wrong before it teach nonsense.
    detector = trained[1]
    windows, labels = synthetic_windows(jax.random.key(8), 200)
    wrong = jnp.where(jnp.arange(200) < 150, 1 - labels, labels)
    same = retrain(jax.random.key(9), detector, windows, wrong)
    assert accuracy(same, windows, labels) >= accuracy(detector, windows, labels) - 0.01


@pytest.mark.parametrize("row", [3, 190])  # of the windows to train with, and to judge by
def test_retraining_that_is_not_finite_says_so(trained, row):
    windows, labels = synthetic_windows(jax.random.key(8), 200)
    found = retrain(jax.random.key(9), trained[1], windows.at[row, 0].set(jnp.nan), labels)
    assert all(np.isnan(x).all() for x in jax.tree.leaves(found.params))
    with pytest.raises(ValueError, match=r"^loss of retrained detectors = (nan|inf): must be fin"):
        detectors.retrain(jax.random.key(9), trained[1], 5e37 * windows, labels)


@pytest.mark.parametrize(("calibration", "number"), [(0.0, 10), (0.5, 1)])
def test_windows_to_train_with_and_to_judge_by_are_needed(trained, calibration, number):
    config = replace(detectors.RETRAINING, calibration=calibration)
    detector = trained[1]
    windows = jnp.zeros((number, len(detector.offset)))
    with pytest.raises(ValueError, match=f"config.calibration = {calibration}: must leave some of"):
        detectors.retrain(jax.random.key(0), detector, windows, jnp.zeros(number, int), config)


def test_windows_and_labels_to_retrain_with_may_be_those_of_numpy(trained):
    windows, labels = synthetic_windows(jax.random.key(5), 40)
    config = replace(CONFIG, steps=2, calibration=0.25)
    of_numpy, of_jax = (
        detectors.retrain(jax.random.key(7), trained[1], *data, config)
        for data in ((np.array(windows), np.array(labels)), (windows, labels))
    )
    jax.tree.map(np.testing.assert_array_equal, of_numpy.params, of_jax.params)
    with pytest.raises(TypeError, match="detector is a Gate; must be a Classifier"):
        detectors.retrain(jax.random.key(7), trained[1].gate, windows, labels, config)
