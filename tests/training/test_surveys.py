"""Surveys of scenes, what each of them is for, and what detectors are trained and calibrated on."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tiny import KEY, SMOKE, TINY, given_problem, stage_of

from jaxsense import looks, training
from jaxsense.config import DetectorConfig, JmvaeConfig
from jaxsense.core import supervised
from jaxsense.training import detections
from jaxsense.training.detections import Survey, Surveys, num_scenes
from jaxsense.vae import detectors
from jaxsense.vae.detectors import Looks


@pytest.fixture
def surveys(monkeypatch) -> Survey:
    """A survey whose windows hold the key that the scene was simulated with."""

    def survey(keys, world, classes, is_empty, places):
        key = jax.random.key_data(keys)[:, -1].astype(jnp.uint32)
        windows = jnp.broadcast_to(key[:, None, None], (*classes.shape, 1))
        number, num_pois = classes.shape
        # Expected at 2 m in empty scenes, and at 1 m in all others.
        distances = jnp.broadcast_to(1.0 + is_empty[:, None, None], (number, 2, num_pois))
        return (windows, windows), distances

    monkeypatch.setattr(looks, "surveys", survey)
    return surveys_of(scenes())


@functools.cache
def scenes():
    return jax.jit(stage_of("scenes", MEASURED).begin)(KEY, MEASURED)


def surveys_of(scenes):
    survey = stage_of("survey", MEASURED)
    return jax.jit(lambda scenes: survey.begin(KEY, MEASURED, scenes=scenes))(scenes)


MEASURED = dataclasses.replace(
    SMOKE,
    detector=DetectorConfig(num_scans=31, num_held_out=25, steps=1),
    jmvae=JmvaeConfig(samples_per_class=10),
)


def used(arrays):
    return set(np.concatenate([np.ravel(x) for x in jax.tree.leaves(arrays)]).tolist())


def test_robots_that_travel_learn_from_looks_by_distance(monkeypatch):
    rng, number = np.random.default_rng(0), 60
    classes = jnp.asarray(rng.integers(0, 3, (number, 3)), jnp.int32)
    far = jnp.asarray(rng.uniform(1, 2, (number, 2, 3)), jnp.float32)
    survey = Survey(classes, (jnp.zeros((number, 3, 1)),) * 2, far)

    def told(trained, windows, distances):
        return tuple((distances[:, m] + 10 * m + 100 * classes)[..., None] for m in range(2))

    monkeypatch.setattr(looks, "features", told)
    team = dataclasses.replace(MEASURED, dqn=dataclasses.replace(MEASURED.dqn, task="team"))
    detect = functools.partial(detections.detect, KEY, surveys=Surveys(survey, *[survey] * 3))
    found = detect(team, trained=())
    for m, (values, far) in enumerate(zip(*vars(found.by_distance).values(), strict=True)):
        assert (np.diff(far) >= 0).all()
        of_class = 10 * m + 100 * np.arange(3)[:, None]
        np.testing.assert_allclose(values[..., 0], far + of_class, rtol=1e-5)
        np.testing.assert_array_equal(values[..., 0], np.sort(found.bank[m][..., 0]))
    assert detect(MEASURED, trained=()).by_distance is None


def test_a_training_measures_on_scenes_that_it_did_not_train_on(surveys, monkeypatch):
    assert len(used(surveys.windows)) == sum(num_scenes(MEASURED))  # no key twice
    trained_on, of_nothing = [], []

    def fit(key, state, problem, number):
        trained_on.append(np.asarray(problem.shown.windows))
        of_nothing.append(np.asarray(problem.nothing.windows))
        return state, jnp.zeros(number)

    listed = {stage.name: stage for stage in training.stages.stages(MEASURED)}
    monkeypatch.setattr(supervised, "fit", fit)
    monkeypatch.setattr(detectors, "problem", given_problem)
    monkeypatch.setattr(detectors, "features", lambda detector, window, distance: window)
    divided = listed["survey"].finish(MEASURED, surveys)
    examples = jax.jit(listed["examples"].begin)(KEY, MEASURED, surveys=divided)
    given = {"surveys": divided, "examples": examples}
    for name in ("detector_camera", "detector_lidar"):
        state = listed[name].begin(KEY, MEASURED, **given)
        listed[name].advance(KEY, MEASURED, state, **given)
    detections = jax.jit(listed["detections"].begin)
    found = detections(KEY, MEASURED, surveys=divided, trained=(None, None))

    seen, bank, held_out = used(trained_on), used(found.bank), used(found.held_out)
    assert seen.isdisjoint(bank)
    assert held_out.isdisjoint(seen | bank)
    assert used(found.windows) <= held_out
    # All of them were looked at.
    assert len(seen) >= 31 / 3
    # And they learn from empty scenes that nothing else uses.
    is_empty = np.asarray(surveys.distances[:, 0, 0]) == 2
    assert is_empty.sum() == num_scenes(MEASURED)[3] == 2  # of 11 to train on
    empty = used([x[is_empty] for x in surveys.windows])
    assert empty.isdisjoint(seen | bank | held_out)
    assert used(np.float32(list(empty))) <= used(examples[0].windows)
    assert used(of_nothing) <= used([x.windows for x in examples])
    assert [x.shape[:2] for x in found.held_out] == [(3, 9), (3, 9)]


@pytest.mark.parametrize(
    ("num_pois", "num_scans", "together", "expected"),
    [
        # 171 scans of 3 PoIs are 57 scenes, with an empty one for each 8; the bank needs 10 looks
        # at each of 3 classes, and 25 held-out looks are 9 at each class.
        (3, 171, 1, (57, 10, 9, 8)),
        (3, 168, 1, (56, 10, 9, 7)),
        (4, 31, 1, (8, 8, 7, 1)),
        # In groups of 4 scenes that show the same PoIs.
        (3, 31, 4, (12, 12, 12, 2)),
    ],
)
def test_numbers_of_scenes(num_pois, num_scans, together, expected):
    learning = {"learns_from": "scans", "fusion": "filter"} if together > 1 else {}
    config = dataclasses.replace(
        MEASURED,
        arena=dataclasses.replace(MEASURED.arena, num_pois=num_pois),
        detector=dataclasses.replace(MEASURED.detector, num_scans=num_scans),
        jmvae=JmvaeConfig(samples_per_class=10, **learning),
    )
    assert num_scenes(config) == expected


NOTHING = Looks(100 + jnp.arange(16.0).reshape(8, 2), jnp.ones(8))


def given_to_detectors(windows, labels):
    """Inputs of a detector's stage, of one PoI a scene."""
    classes = 2 * labels[:, None]  # a green cylinder, or a red cube
    of_both, distances = (windows[:, None],) * 2, jnp.ones((len(labels), 2, 1))
    survey = Survey(classes, of_both, distances)
    others = Survey(classes, tuple(200 + x for x in of_both), distances)
    return {"surveys": Surveys(survey, others, others, others), "examples": (NOTHING, NOTHING)}


@pytest.mark.parametrize(("share", "trained_on"), [(0.0, 10), (0.25, 7)])
def test_looks_that_calibrate_a_detector_are_not_trained_on(share, trained_on, monkeypatch):
    config = dataclasses.replace(TINY.detector, calibration=share, num_scans=10)
    arena = dataclasses.replace(TINY.arena, num_pois=1)
    config = dataclasses.replace(TINY, detector=config, arena=arena)
    # Of .25 of ten looks, three calibrate.
    windows, labels = jnp.arange(20.0).reshape(10, 2), jnp.arange(10) % 2
    given, used = given_to_detectors(windows, labels), {}

    def fit(key, state, problem, number):
        used["problem"] = problem
        return state, jnp.zeros(number)

    def calibrate(detector, shown, labels):
        used["calibrate"] = shown.windows
        np.testing.assert_array_equal(labels, (shown.windows[:, 0] / 2) % 2)
        return detector

    def fitted(detector, shown, nothing):
        used["checks"], used["nothing"] = shown.windows, nothing.windows
        return "fitted"

    monkeypatch.setattr(supervised, "fit", fit)
    monkeypatch.setattr(detectors, "problem", given_problem)
    monkeypatch.setattr(detectors, "calibrate", calibrate)
    monkeypatch.setattr(detectors, "fitted", fitted)
    stage = stage_of("detector_lidar", config)
    state = stage.begin(KEY, config, **given)
    state, _ = stage.advance(KEY, config, state, **given)
    assert stage.finish(config, state, **given) == "fitted"
    np.testing.assert_allclose(state[0].offset, windows[:trained_on].mean(axis=0))
    problem = used["problem"]
    np.testing.assert_array_equal(problem.shown.windows, windows[:trained_on])
    np.testing.assert_array_equal(problem.labels, labels[:trained_on])
    # A quarter of the looks at nothing sets the threshold, with looks of the bank.
    np.testing.assert_array_equal(problem.nothing.windows, NOTHING.windows[2:])
    np.testing.assert_array_equal(used["nothing"], NOTHING.windows[:2])
    np.testing.assert_array_equal(used["checks"], 200 + windows)
    assert ("calibrate" in used) == (share > 0)
    if share:
        np.testing.assert_array_equal(used["calibrate"], windows[trained_on:])
