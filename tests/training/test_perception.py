"""Stages of perception: what detectors, the JMVAE and fusion are trained on."""

import dataclasses
import functools
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tiny import KEY, SMOKE, TINY, stage_of

from jaxsense import looks, models, training
from jaxsense.config import DetectorConfig, JmvaeConfig
from jaxsense.core import supervised
from jaxsense.core.types import Belief
from jaxsense.sim.world import make_world
from jaxsense.training import perception
from jaxsense.training.gating import Examples
from jaxsense.training.perception import Detections, Survey, Surveys
from jaxsense.vae import detectors, gate, jmvae


def bank_of(bank) -> Detections:
    """Detections for training, without any to measure on."""
    nothing: Any = ()
    return Detections(bank, nothing, nothing, nothing)


def given_to_detectors(windows, labels):
    """Inputs of a detector's stage, of one PoI a scene; looks at nothing are those at PoIs."""
    looks, nothing = gate.Looks(windows, jnp.ones(len(windows))), cast("Any", ())
    examples = Examples(labels, looks.distances, looks, looks)
    survey = Survey(
        labels[:, None], nothing, (windows[:, None],) * 2, jnp.ones((len(labels), 2, 1))
    )
    return {"surveys": Surveys(survey, nothing), "examples": (examples, examples)}


@pytest.mark.slow
@pytest.mark.parametrize(("share", "trained_on"), [(0.0, 10), (0.1, 9), (0.25, 7), (0.5, 5)])
def test_looks_that_calibrate_a_detector_are_not_trained_on(share, trained_on, monkeypatch):
    config = dataclasses.replace(TINY.detector, calibration=share)
    config = dataclasses.replace(TINY, detector=config)
    # Of .25 of ten looks, three calibrate.
    windows, labels = jnp.arange(20.0).reshape(10, 2), jnp.arange(10) % 2
    given, used = given_to_detectors(windows, labels), {}

    def fit(key, state, problem, number):
        used["train"], used["labels"] = problem.detector.windows, problem.detector.labels
        used["shown"] = problem.gate.shown.windows
        return state, jnp.zeros(number)

    def calibrate(detector, windows, labels):
        used["calibrate"] = windows
        np.testing.assert_array_equal(labels, (windows[:, 0] / 2) % 2)
        return "calibrated"

    monkeypatch.setattr(supervised, "fit", fit)
    monkeypatch.setattr(detectors, "calibrate", calibrate)
    stage = stage_of("detector_lidar", config)
    state = stage.begin(KEY, config, **given)
    state, _ = stage.advance(KEY, config, state, **given)
    found = stage.finish(config, state, **given)
    np.testing.assert_allclose(state[0].offset, windows[:trained_on].mean(axis=0))
    np.testing.assert_array_equal(used["train"], windows[:trained_on])
    np.testing.assert_array_equal(used["shown"], windows[:trained_on])
    np.testing.assert_array_equal(used["labels"], labels[:trained_on])
    if share:
        np.testing.assert_array_equal(used["calibrate"], windows[trained_on:])
        assert found == "calibrated"
    else:
        assert "calibrate" not in used


@pytest.mark.slow
def test_without_calibration_a_detector_is_what_was_trained():
    windows, labels = jax.random.normal(KEY, (48, 6)), jnp.arange(48) % 2
    given, config = given_to_detectors(windows, labels), TINY.detector
    assert config.calibration == 0
    stage = stage_of("detector_camera")
    state = stage.begin(KEY, TINY, **given)
    detector = detectors.init(KEY, windows, 2, config)
    problem = detectors.Fitting(config, detector, windows, labels)
    fit = supervised.start(detector.params, config)
    for key in stage.chunk_keys(KEY)[:2]:
        state, _ = stage.advance(key, TINY, state, **given)
        fit, _ = supervised.fit(key, fit, problem, 3)
    found = stage.finish(TINY, state, **given)
    # Its gate, which learns in the same steps, leaves it as it is.
    expected = dataclasses.replace(detector, params=fit.params, gate=found.gate)
    jax.tree.map(np.testing.assert_array_equal, found, expected)
    before, after = (jax.tree.leaves(x.gate.params)[1] for x in (detector, found))
    assert np.abs(after - before).max() > 0
    assert np.isfinite(found.gate.threshold)


@pytest.mark.slow
def test_the_loss_of_a_restart_is_the_mean_of_its_last_chunk(monkeypatch):
    # 41 steps are 14 chunks of 3, the last of which has 2. The loss of a step is its number.
    monkeypatch.setattr(jmvae.Fitting, "loss", lambda self, params, drawn, step: step + 1.0)
    stage, detections = stage_of("jmvae_1"), bank_of((jnp.ones((3, 4, 2)),) * 2)

    @jax.jit
    def advance(state):
        state, progress = stage.advance(KEY, TINY, state, detections=detections)
        return state, progress, stage.finish(TINY, state, detections=detections)[1]

    state, seen = jax.jit(lambda: stage.begin(KEY, TINY, detections=detections))(), []
    for _ in range(stage.chunks):
        state, progress, loss = advance(state)
        seen.append(float(loss))
        assert len(progress.loss) == 3
    assert seen[0] == 2.0  # of 1, 2, 3
    assert seen[-1] == 40.5  # of 40 and 41


# The camera tells class 0 from the others, the LiDAR class 2. Classes in the same place cannot be
# read from a belief.
CORNER = Belief(jnp.array([[-1.0, 1.0], [1.0, 1.0], [1.0, -1.0]]), jnp.full((3, 2), 0.3))
PLACE = Belief(jnp.ones((3, 2)), jnp.full((3, 2), 0.3))


@jax.jit
def kept(losses, classes):
    """The restart that is kept, by losses and beliefs of the classes."""
    restarts = tuple((jnp.int32(i), losses[i]) for i in range(len(losses)))
    of_restart = lambda *_, params, detections: jax.tree.map(lambda x: x[params], classes)  # noqa: E731
    camera = np.float32([[0.1, 0.9], [0.9, 0.1], [0.9, 0.1]])[:, None]
    given = {
        "restarts": restarts,
        "detections": bank_of((jnp.asarray(camera), jnp.asarray(camera[::-1]))),
    }
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(perception, "class_beliefs", of_restart)
        return stage_of("best_jmvae").begin(KEY, TINY, **given)


def best_of(losses, classes):
    stacked = jax.tree.map(lambda *x: np.stack([np.asarray(y) for y in x]), *classes)
    return int(kept(np.float32(losses), stacked))


@pytest.mark.slow
def test_the_exact_restart_with_the_lowest_loss_is_kept():
    nan, inf = jnp.nan, jnp.inf
    for losses, expected in {(1, 0.5, 0.9): 1, (1, nan, 0.9): 2, (nan, inf): 0, (nan,): 0}.items():
        assert best_of(losses, [CORNER] * len(losses)) == expected
    # From equal places no class can be read, whatever the loss.
    assert best_of((1, 0.5, 0.9), [CORNER, PLACE, CORNER]) == 2
    assert best_of((nan, 0.5, 0.9), [CORNER, PLACE, PLACE]) == 1


def test_of_inexact_restarts_the_most_exact_is_kept():
    line = Belief(jnp.array([[0.0, 0.0], [1.0, 0.0], [1.0, 0.0]]), jnp.full((3, 2), 0.3))
    assert best_of((0.5, 0.9, 0.5), [PLACE, line, PLACE]) == 1


@pytest.fixture
def surveys(monkeypatch) -> Survey:
    """A survey whose windows, and scenes, hold the key that the scene was simulated with."""

    def survey(keys, world, classes, is_empty, places):
        key = jax.random.key_data(keys)[:, -1].astype(jnp.uint32)
        windows = jnp.broadcast_to(key[:, None, None], (*classes.shape, 1))
        number, num_pois = classes.shape
        # Expected at 2 m in empty scenes, and at 1 m in all others.
        distances = jnp.broadcast_to(1.0 + is_empty[:, None, None], (number, 2, num_pois))
        return key, (windows, windows), distances

    monkeypatch.setattr(looks, "surveys", survey)
    return surveys_of(scenes())


@functools.cache
def scenes():
    return jax.jit(stage_of("scenes", MEASURED).begin)(KEY, MEASURED)


def surveys_of(scenes):
    survey = stage_of("survey", MEASURED)
    return jax.jit(lambda scenes: survey.begin(KEY, MEASURED, scenes=scenes))(scenes)


def test_scenes_are_as_empty_whoever_works_them_out(surveys):
    """Threads and devices share the rows of a survey."""
    half = len(scenes()[0]) // 2
    parts = [
        surveys_of(jax.tree.map(lambda x: x[part], scenes()))  # noqa: B023
        for part in (slice(half), slice(half, None))
    ]
    together = np.concatenate([part.distances for part in parts])
    np.testing.assert_array_equal(together, surveys.distances)
    assert (together[:half] == 1).all()
    assert (together == 2).any()


MEASURED = dataclasses.replace(
    SMOKE,
    detector=DetectorConfig(num_scans=31, num_held_out=25, steps=1),
    jmvae=JmvaeConfig(samples_per_class=10),
    dqn=dataclasses.replace(SMOKE.dqn, observe="live", num_starts=2 * SMOKE.dqn.num_envs),
)


def used(arrays):
    return set(np.concatenate([np.ravel(x) for x in jax.tree.leaves(arrays)]).tolist())


def test_a_training_measures_on_scenes_that_it_did_not_train_on(surveys, monkeypatch):
    assert len(used(surveys.scenes)) == sum(perception.num_scenes(MEASURED))  # no key twice
    trained_on, shown_to_gates = [], []

    def fit(key, state, problem, number):
        trained_on.append(np.asarray(problem.detector.windows))
        shown_to_gates.append(np.asarray(problem.gate.shown.windows))
        return state, jnp.zeros(number)

    listed = {stage.name: stage for stage in training.stages.stages(MEASURED)}
    monkeypatch.setattr(supervised, "fit", fit)
    monkeypatch.setattr(detectors, "detect", lambda detector, window: window)
    divided = listed["survey"].divide(MEASURED, surveys)
    examples = jax.jit(listed["examples"].begin)(KEY, MEASURED, surveys=divided)
    given = {"surveys": divided, "examples": examples}
    for name in ("detector_camera", "detector_lidar"):
        state = listed[name].begin(KEY, MEASURED, **given)
        listed[name].advance(KEY, MEASURED, state, **given)
    detections = jax.jit(listed["detections"].begin)
    found = detections(KEY, MEASURED, surveys=divided, trained=(None, None))

    seen, bank, held_out = used(trained_on), used(found.bank), used(found.held_out)
    starts, plotted = used(found.starts.scenes), used(found.windows)
    assert seen.isdisjoint(bank)
    assert held_out.isdisjoint(seen | bank | starts)
    assert starts.isdisjoint(seen)
    assert plotted <= held_out
    # All of them were looked at.
    assert len(seen) >= 31 / 3
    # Gates learn from the same scenes, and from empty ones that nothing else uses.
    checks = used(examples[0].checks.windows)
    assert used(shown_to_gates) == seen
    assert checks <= bank | starts
    assert set(examples[0].distances.tolist()) == {1.0}
    is_empty = np.asarray(surveys.distances[:, 0, 0]) == 2
    assert is_empty.sum() == perception.num_scenes(MEASURED)[3] == 2  # of 11 to train on
    empty = used(surveys.scenes[is_empty])
    assert empty.isdisjoint(seen | bank | held_out | starts)
    assert used(np.float32(list(empty))) <= used(examples[0].nothing.windows)
    assert [x.shape[:2] for x in found.held_out] == [(3, 9), (3, 9)]


@pytest.mark.slow
def test_a_scene_is_the_same_whoever_works_it_out():
    listed = {stage.name: stage for stage in training.stages.stages(TINY, make_world(TINY).arena)}
    scenes = listed["scenes"].begin(KEY, TINY)
    survey = jax.jit(listed["survey"].begin)
    first, second = (
        survey(KEY, TINY, scenes=jax.tree.map(lambda x: x[i : i + 4], scenes))  # noqa: B023
        for i in (0, 2)
    )
    same = jax.tree.map(lambda x, y: np.abs(x[2:] - y[:2]).max(), first.scenes, second.scenes)
    assert max(jax.tree.leaves(same)) < 1e-6
    assert np.abs(first.scenes.poses[0] - first.scenes.poses[1]).max() > 0.01


def test_beliefs_of_classes_are_of_detections_for_training():
    # Nothing else can be encoded.
    params = jax.jit(lambda: jmvae.init(KEY, models.make_jmvae(TINY)))()
    bank = tuple(jnp.full((3, 4, 2), 0.5) for _ in range(2))
    stage = stage_of("class_beliefs")
    found = jax.jit(stage.begin)(KEY, TINY, params=params, detections=bank_of(bank))
    posterior = jax.jit(jmvae.posterior, static_argnums=1)
    expected = posterior(params, models.make_jmvae(TINY), tuple(x[0, 0] for x in bank))
    np.testing.assert_allclose(found.mean, jnp.tile(expected.mean, (3, 1)), rtol=1e-5)
