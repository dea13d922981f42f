"""Gates on windows whose answer is known."""

import functools
import re
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsense.config import DetectorConfig
from jaxsense.core import supervised
from jaxsense.dqn.optimum import LookValues
from jaxsense.vae import detectors, gate

CONFIG = DetectorConfig(hidden=(8,), steps=300, batch=64, learning_rate=1e-2)
RAYS = 6


@functools.partial(jax.jit, static_argnums=(1, 2))
def looks(key, number, is_shown):
    """Ranges of 3 m in which, at the distance of its PoI, the two rays of a PoI stand out."""
    distance_key, noise_key = jax.random.split(key)
    distances = jax.random.uniform(distance_key, (number,), minval=0.5, maxval=2.0)
    of_poi = jnp.array([0.0, 0.0, 1.0, 1.0, 0.0, 0.0])[None]
    at = distances[:, None] if is_shown else jnp.roll(distances, 1)[:, None] + 0.5
    windows = jnp.where(of_poi > 0, at, 3.0) + 0.02 * jax.random.normal(noise_key, (number, RAYS))
    return gate.Looks(windows, distances)


@pytest.fixture(scope="module")
def problem():
    keys = jax.random.split(jax.random.key(0), 2)
    shown, nothing = looks(keys[0], 500, True), looks(keys[1], 300, False)
    untrained = gate.init(jax.random.key(1), shown.windows.mean(axis=0), jnp.float32(1.0), False)
    return gate.Fitting(CONFIG, untrained, shown, nothing)


@pytest.fixture(scope="module")
def params(problem):
    start = supervised.start(problem.gate.params, CONFIG)
    fit = jax.jit(lambda key, state: supervised.fit(key, state, problem, CONFIG.steps))
    return fit(jax.random.key(2), start)[0].params


answer = jax.jit(detectors.answer)


def passes(found, window, distance):
    """What a detector with this gate says of a look."""
    windows = jax.random.normal(jax.random.key(0), (20, RAYS))
    detector = detectors.init(jax.random.key(1), windows, 2, CONFIG)
    return detectors.answer(replace(detector, gate=found), window, distance).is_there


passing = jax.jit(jax.vmap(passes, (None, 0, 0)))


def share(found, looks):
    return float(passing(found, looks.windows, looks.distances).mean())


def test_a_trained_gate_passes_pois_where_they_are_expected(problem, params):
    found = jax.jit(gate.fitted)(params, problem)
    keys = jax.random.split(jax.random.key(3), 2)
    assert share(found, looks(keys[0], 2000, True)) >= 0.97
    assert share(found, looks(keys[1], 2000, False)) <= 0.05


def with_scores(monkeypatch):
    """Looks whose score is their distance."""
    monkeypatch.setattr(gate, "logits", lambda gate, windows, distances: distances)
    return lambda distances: gate.Looks(
        np.zeros((len(distances), RAYS), np.float32), jnp.asarray(distances, jnp.float32)
    )


def test_a_threshold_loses_one_look_in_a_hundred_and_no_more_than_needed(monkeypatch, problem):
    of = with_scores(monkeypatch)
    scores = np.arange(1001.0)  # of looks at PoIs: 1 % of them are below 10
    overlapping = replace(problem, shown=of(scores), nothing=of(scores + 5.0))
    fitted = jax.jit(lambda problem: gate.fitted({}, problem))
    assert fitted(overlapping).threshold == pytest.approx(10.0)
    # 0.2 % of the looks at nothing are above 5.99 of 0 to 6.
    apart = replace(problem, shown=of(scores), nothing=of(np.linspace(0.0, 6.0, 1001)))
    assert fitted(apart).threshold == pytest.approx(0.998 * 6.0)


def test_a_window_at_the_threshold_passes(monkeypatch, problem):
    with_scores(monkeypatch)
    found, window = replace(problem.gate, threshold=jnp.float32(0.8)), jnp.zeros(RAYS)
    for distance, expected in ((0.79, False), (0.8, True), (0.9, True)):
        assert bool(passes(found, window, jnp.float32(distance))) is expected


@pytest.mark.parametrize(
    ("reading", "distance", "expected"),
    [
        (1.0, 1.0, True),
        (np.nan, 1.0, False),
        (np.inf, 1.0, False),
        (-np.inf, 1.0, False),
        (1.0, np.nan, False),
        (1.0, np.inf, False),
        (1.0, 0.0, False),
        (1.0, -1.0, False),
    ],
)
def test_an_untrained_gate_passes_what_is_valid(problem, reading, distance, expected):
    window = np.zeros(RAYS, np.float32)
    window[2] = reading
    found = passing(problem.gate, window[None], np.float32([distance]))[0]
    assert bool(found) is expected


def test_a_gate_of_distances_reads_how_far_they_are_from_the_poi(problem):
    ranging = replace(problem.gate, measures_distance=True)
    window = np.linspace(0.9, 1.1, RAYS, dtype=np.float32)
    # Without what reads the expected distance itself.
    weights = jax.tree.map(np.array, ranging.params)
    weights["params"]["Dense_0"]["kernel"][RAYS:] = 0.0
    of_range = replace(ranging, params=weights)

    logits = jax.jit(gate.logits)

    def score(window, distance):
        return float(logits(of_range, window, np.float32(distance)))

    near = score(window, 1.0)
    assert score(window + 0.5, 1.5) == pytest.approx(near, abs=1e-5)
    assert score(window + 0.1, 1.0) != pytest.approx(near, abs=1e-3)
    # Beyond half a metre it makes no difference how far.
    assert score(window + 2.0, 1.0) == pytest.approx(score(window + 3.0, 1.0), abs=1e-5)


def test_as_many_are_drawn_of_either_kind(problem):
    few = replace(problem, nothing=jax.tree.map(lambda x: x[:3], problem.nothing))
    rows = np.asarray(jax.jit(few.draw, static_argnums=1)(jax.random.key(0), 50))
    assert rows.shape == (50, 2, 32)
    assert set(rows[:, 1].ravel()) == {0, 1, 2}
    assert rows[:, 0].max() > 400


def test_the_loss_is_the_mean_cross_entropy(monkeypatch, problem):
    of = with_scores(monkeypatch)
    of_looks = replace(problem, shown=of([2.0, 0.0]), nothing=of([1.0, -1.0]))
    drawn = jnp.array([[0, 1], [0, 0]])
    # -log sigmoid(2) = .126928, -log sigmoid(0) = .693147; -log(1 - sigmoid(1)) = 1.313262 twice.
    expected = (0.126928 + 0.693147 + 2 * 1.313262) / 4
    assert of_looks.loss({}, drawn, jnp.int32(0)) == pytest.approx(expected, abs=1e-5)


def test_what_does_not_pass_has_no_features_of_a_class():
    windows = jax.random.normal(jax.random.key(0), (20, RAYS))
    detector = detectors.init(jax.random.key(1), windows, 3, CONFIG)
    distance = jnp.float32(1.0)
    found = answer(detector, windows[0], distance)
    assert found.is_there
    expected = jax.jit(detectors.detect)(detector, windows[0])
    np.testing.assert_allclose(found.features, expected, rtol=1e-6)
    closed = replace(detector, gate=replace(detector.gate, threshold=jnp.float32(jnp.inf)))
    for found in (
        answer(closed, windows[0], distance),
        answer(detector, windows[0].at[1].set(jnp.nan), distance),
    ):
        assert not found.is_there
        np.testing.assert_allclose(found.features, [1 / 3] * 3)


def test_a_search_of_one_window_is_a_look(problem):
    windows = jax.random.normal(jax.random.key(0), (20, RAYS))
    detector = detectors.init(jax.random.key(1), windows, 3, CONFIG)
    search = jax.jit(detectors.search)
    for window in (windows[0], windows[1].at[1].set(jnp.nan)):
        plain = answer(detector, window, jnp.float32(1.0))
        found = search(detector, window[None], jnp.ones(1), jnp.zeros((1, 1)))
        assert found.is_there == plain.is_there
        np.testing.assert_allclose(found.features, plain.features, atol=1e-6)


def test_a_search_pools_the_windows_by_their_posterior_odds(monkeypatch):
    # The first reading is the log-odds of the window, the second the logit of a label.
    monkeypatch.setattr(gate, "logits", lambda g, windows, at: windows[0] - jnp.abs(at - 1.0))
    detector = Read(Threshold(jnp.float32(1.5)))
    windows = jnp.array([[2.0, 3.0], [2.0, -1.0], [9.0, 5.0], [np.nan, 5.0]])
    prior = jnp.array([0.0, -np.log(3.0), -np.inf, 0.0])
    search = jax.jit(lambda *given: detectors.search(detector, *given))
    found = search(windows, jnp.array([1.0]), prior[None])
    # Shares 3/4 and 1/4: a logit of 3 x .75 - 1 x .25 = 2, and the sigmoid of 2 is .8808.
    assert found.is_there
    np.testing.assert_allclose(found.features, [0.8808, 0.1192], atol=1e-4)
    # Log-odds of 2 and, at the other distance, of 2 - x: a mean of 2 - log 2 + log(1 + e^-x), which
    # is 1.5 for x = 1.55. A distance that is not positive is none, and has no share in the mean.
    for distances, is_there in (
        *(([1.0, 2.5], True), ([1.0, 2.6], False), ([1.0, -1.0], True), ([1.0, np.nan], True)),
        ([-1.0, np.nan], False),
    ):
        both = jnp.tile(prior, (2, 1))
        found = search(windows, jnp.array(distances), both)
        assert bool(found.is_there) is is_there
        assert is_there or found.features.tolist() == [0.5, 0.5]
    nowhere = jnp.full((1, 4), -jnp.inf)
    assert not search(windows, jnp.ones(1), nowhere).is_there


def test_a_search_takes_no_window_for_impossible(monkeypatch):
    monkeypatch.setattr(gate, "logits", lambda g, windows, at: windows[0])
    detector = Read(Threshold(jnp.float32(0.0)))
    # Certain of one label in one window, and of the other in the next.
    windows = jnp.array([[2.0, 200.0], [2.0, -200.0]])
    found = detectors.search(detector, windows, jnp.ones(1), jnp.zeros((1, 2)))
    np.testing.assert_allclose(found.features, [0.5, 0.5], atol=1e-6)


@dataclass(frozen=True)
class Threshold:
    """The threshold of a gate, and nothing else."""

    threshold: Any


@dataclass(frozen=True)
class Read:
    """A detector of two labels, whose logit is the second reading."""

    gate: Any
    num_labels: int = 2

    def features(self, window):
        probability = jax.nn.sigmoid(window[1])
        return jnp.stack([probability, 1 - probability])


def test_no_product_of_a_search_or_a_value_has_the_precision_of_the_device():
    windows = jax.random.normal(jax.random.key(0), (20, RAYS))
    detector = detectors.init(jax.random.key(1), windows, 3, CONFIG)
    values = LookValues(jnp.ones(3), jnp.ones(3), *jnp.ones(2), jnp.ones((4, 2)))
    for traced in (
        jax.make_jaxpr(detectors.search)(detector, windows, jnp.ones(2), jnp.zeros((2, 20))),
        jax.make_jaxpr(values.of_next)(jnp.full(4, 0.25), jnp.bool_(True)),
    ):
        products = re.findall(r"dot_general\[(.*?)\] ", str(traced), re.DOTALL)
        assert products
        assert all("precision=(Precision.HIGHEST" in each for each in products), products
