"""A JMVAE that learns from scans: groups of looks, and labels that only name what it has found."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tiny import given_problem, inputs_of, learn_by_stages

from jaxsense import PRESETS, Config, looks, training
from jaxsense.config import DetectorConfig, JmvaeConfig
from jaxsense.config.learning import FilterConfig
from jaxsense.core import supervised
from jaxsense.models import make_scan_jmvae
from jaxsense.training import scans
from jaxsense.training.detections import Shown, draw_scenes, num_scenes, repeated
from jaxsense.training.stage import Stage
from jaxsense.vae import detectors, leave_one_out

SMOKE = PRESETS["smoke"]
TINY = dataclasses.replace(
    SMOKE,
    detector=DetectorConfig(num_scans=120, calibration=0.25, num_held_out=36, steps=2, batch=8),
    jmvae=JmvaeConfig(
        learns_from="scans", fusion="filter", hidden=(8,), steps=2, batch=4,
        restarts=2, samples_per_class=12,
    ),
    filter=FilterConfig(steps=2),
)  # fmt: skip
KEY = jax.random.key(0)


def stages_of(config: Config) -> dict[str, Stage]:
    return {stage.name: stage for stage in training.stages.stages(config)}


@functools.cache
def beginning(name: str):
    """A stage's `begin`, in one program for all inputs."""
    stage = stages_of(TINY)[name]
    return jax.jit(lambda inputs: stage.begin(stage.key(KEY), TINY, **inputs))


def begun(name: str, outputs) -> Any:
    return beginning(name)(inputs_of(name, TINY, outputs))


@pytest.fixture(scope="module")
def learned():
    """All stages up to `shown`, of what was drawn, not seen, without steps of learning."""

    def surveys(keys, world, classes, is_empty, places):
        shape, windows = classes.shape, [sensor.window for sensor in world.sensors]
        camera, lidar = (
            jax.random.uniform(keys[m], (*shape, n * (1, 3)[m == 0])) for m, n in enumerate(windows)
        )
        return (camera, lidar), jnp.ones((shape[0], 2, shape[1]))

    once = dataclasses.replace(TINY, jmvae=dataclasses.replace(TINY.jmvae, restarts=1))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(looks, "surveys", surveys)
        still = lambda key, state, problem, number: (state, jnp.zeros(number))  # noqa: E731
        patch.setattr(supervised, "fit", still)
        return learn_by_stages(KEY, once, until="shown")


def test_scenes_come_in_groups_that_show_the_same_pois():
    draw = jax.jit(draw_scenes)
    keys, classes, is_empty, places = draw(KEY, TINY)
    number = sum(num_scenes(TINY)[:3])
    assert number % 4 == 0
    grouped = classes[:number].reshape(-1, 4, classes.shape[1])
    np.testing.assert_array_equal(grouped, jnp.repeat(grouped[:, :1], 4, axis=1))
    assert not is_empty[:number].any()
    of_groups = np.asarray(jax.random.key_data(places))[:number].reshape(-1, 4, 2)
    assert (of_groups == of_groups[:, :1]).all()
    assert len({tuple(x) for x in of_groups[:, 0]}) == len(of_groups)
    of_scenes = {tuple(x) for x in np.asarray(jax.random.key_data(keys))}
    assert len(of_scenes) == len(keys)
    assert not of_scenes & {tuple(x) for x in of_groups[:, 0]}
    plain = draw(KEY, dataclasses.replace(TINY, jmvae=JmvaeConfig()))
    assert plain[3] is None


def test_no_label_enters_the_training(learned):
    """Other labels of the same scenes change names, and nothing that is learned."""
    surveys = learned.outputs["survey"]
    training = surveys.training
    training = dataclasses.replace(training, classes=(training.classes + 1) % 3)
    other = dataclasses.replace(surveys, training=training)
    both = surveys, other
    views = [begun("views", {"survey": s}) for s in both]
    for one, two in zip(*map(jax.tree.leaves, views), strict=True):
        np.testing.assert_array_equal(one, two)
    params = learned.outputs["best_jmvae"]

    @jax.jit
    def class_beliefs(views, surveys):
        return scans.class_beliefs(KEY, TINY, params=params, views=views, surveys=surveys)

    found, renamed = (class_beliefs(v, s) for v, s in zip(views, both, strict=True))
    # Class c is now what was called c - 1 before.
    np.testing.assert_allclose(renamed.mean, jnp.roll(found.mean, 1, axis=0), atol=1e-6)


def test_looks_for_training_are_sorted_by_what_all_looks_show(learned, monkeypatch):
    """A PoI that looks like another class goes there, whatever its label."""
    outputs = learned.outputs
    num_bank = num_scenes(TINY)[1]
    shown = jnp.arange(num_bank * TINY.arena.num_pois).reshape(num_bank, -1) % 3
    features = lambda trained, windows, distances: (shown[..., None],) * len(windows)  # noqa: E731
    monkeypatch.setattr(looks, "features", features)
    taken_for = Shown(outputs["shown"].calibrating, bank=shown)
    untrained = {"detector_camera": (), "detector_lidar": ()}
    found = begun("detections", {**outputs, **untrained, "shown": taken_for})
    for bank in found.bank:
        np.testing.assert_array_equal(bank[..., 0], np.repeat([[0], [1], [2]], 12, axis=1))


def test_what_all_looks_show_is_the_class_nearest_to_their_posterior(learned):
    outputs, model = learned.outputs, make_scan_jmvae(TINY)
    classes, num_bank = np.asarray(outputs["class_beliefs"].mean), num_scenes(TINY)[1]
    posterior = jax.jit(lambda given: leave_one_out.posterior(outputs["best_jmvae"], model, given))
    scalings = [jax.jit(jax.vmap(scaling)) for scaling in outputs["views"].scalings]

    def plain(survey, scene, poi):
        looks = (np.asarray(x)[scene : scene + 4, poi] for x in survey.windows)
        mean = posterior(tuple(f(x) for f, x in zip(scalings, looks, strict=True))).mean
        return np.argmin(np.sum((classes - np.asarray(mean)) ** 2, axis=1))

    shown, surveys = outputs["shown"], outputs["survey"]
    calibrating = jax.tree.map(lambda x: x[-12:], surveys.training)
    assert shown.bank.shape == (num_bank, 3)
    assert shown.calibrating.shape == (12, 3)
    for scene, poi in ((0, 0), (4, 2), (8, 1)):
        for found, survey in ((shown.bank, surveys.bank), (shown.calibrating, calibrating)):
            expected = plain(survey, scene, poi)
            np.testing.assert_array_equal(found[scene : scene + 4, poi], expected)


def test_encoders_are_calibrated_with_looks_that_nothing_learned_from(learned, monkeypatch):
    """A quarter of 10 groups of scenes, rounded up: 3 groups of 4."""
    outputs, stage = learned.outputs, stages_of(TINY)["detector_camera"]
    windows = np.asarray(outputs["survey"].training.windows[0])
    num_train, _, size = windows.shape
    assert num_train == num_scenes(TINY)[0] == 40
    given = []

    def calibrate(encoder, *given_here):
        given.extend(given_here)
        return encoder

    def fit(key, state, problem, number):
        used.append(problem)
        return state, ()

    used = []
    monkeypatch.setattr(leave_one_out, "calibrate", calibrate)
    monkeypatch.setattr(supervised, "fit", fit)
    monkeypatch.setattr(detectors, "problem", given_problem)
    inputs = inputs_of(stage.name, TINY, outputs)
    state = stage.begin(KEY, TINY, **inputs)
    state, _ = stage.advance(KEY, TINY, state, **inputs)
    encoder, problem = stage.finish(TINY, state, **inputs), used[0]
    np.testing.assert_array_equal(given[0], windows[28:].reshape(-1, size))
    np.testing.assert_array_equal(given[1], outputs["shown"].calibrating.reshape(-1))
    np.testing.assert_array_equal(problem.shown.windows, windows[:28].reshape(-1, size))
    np.testing.assert_allclose(encoder.presence.offset, windows[:28].mean(axis=(0, 1)), rtol=1e-5)
    assert all(len(x) == 7 * TINY.arena.num_pois for x in outputs["views"].groups)


REPEATING = dataclasses.replace(TINY, detector=dataclasses.replace(TINY.detector, num_repeats=30))


def test_repeated_looks_are_at_pois_of_the_bank_and_show_what_all_looks_show(learned):
    scenes, num_train = learned.outputs["scenes"], num_scenes(TINY)[0]
    _, classes, _, places = scenes
    num_bank = num_scenes(TINY)[1]
    bank = (classes[num_train : num_train + num_bank] + 1) % 3  # nowhere the true class
    seen, of_places, taken_for = repeated(KEY, REPEATING, scenes, Shown(bank[:0], bank))
    assert seen.shape == (30, 3)
    assert of_places is not None
    np.testing.assert_array_equal(taken_for, (seen[:, 0] + 1) % 3)
    groups = num_bank // 4
    assert groups < 30
    # The i-th scene shows the PoIs of the i-th group of four scenes, then the first again.
    of_scenes = jax.random.key_data(places)[num_train : num_train + num_bank]
    expected = np.asarray(of_scenes)[np.arange(30) % groups * 4]
    np.testing.assert_array_equal(jax.random.key_data(of_places), expected)
