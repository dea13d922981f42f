"""A JMVAE that learns from scans: groups of looks, and labels that only name what it has found."""

import dataclasses
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tiny import inputs_of, learn_by_stages

from jaxsense import PRESETS, Config, looks, training
from jaxsense.config import ConfigError, DetectorConfig, FilterConfig, JmvaeConfig
from jaxsense.core import supervised
from jaxsense.models import make_shape
from jaxsense.sim import world as worlds
from jaxsense.training import detections, scans
from jaxsense.training.scans import Shown
from jaxsense.training.stage import Stage
from jaxsense.training.surveys import Survey, divide, draw_scenes, num_scenes
from jaxsense.vae import detectors, leave_one_out, novelty

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


def begun(stage: Stage, config: Config, outputs) -> Any:
    """What a stage begins with, in one program."""
    key = stage.key(KEY)
    inputs = inputs_of(stage.name, config, outputs)
    return jax.jit(lambda inputs: stage.begin(key, config, **inputs))(inputs)


@pytest.fixture(scope="module")
def learned():
    """All stages up to `grouped`, with a single JMVAE."""
    once = dataclasses.replace(TINY, jmvae=dataclasses.replace(TINY.jmvae, restarts=1))
    return learn_by_stages(KEY, once, until="grouped")


def test_the_restart_with_the_lowest_finite_loss_is_kept():
    restarts = tuple((jnp.float32(i), jnp.float32(x)) for i, x in enumerate((np.nan, 2.0, 1.0)))
    best = jax.jit(lambda restarts: scans.best(KEY, TINY, restarts=restarts))
    assert best(restarts) == 2
    assert best(restarts[:2]) == 1
    assert best(restarts[:1]) == 0


def test_a_jmvae_of_scans_comes_before_its_detectors():
    names = list(stages_of(TINY))
    assert names[:12] == [
        "scenes", "survey", "examples", "views", "jmvae_1", "jmvae_2", "best_jmvae",
        "class_beliefs", "shown", "detector_camera", "detector_lidar", "detections",
    ]  # fmt: skip


def test_scenes_come_in_groups_that_show_the_same_pois():
    draw = jax.jit(draw_scenes)
    keys, classes, is_empty, places = draw(KEY, TINY)
    number = sum(num_scenes(TINY)[:3])
    assert number % 3 == 0
    grouped = classes[:number].reshape(-1, 3, classes.shape[1])
    np.testing.assert_array_equal(grouped, jnp.repeat(grouped[:, :1], 3, axis=1))
    assert not is_empty[:number].any()
    of_groups = np.asarray(jax.random.key_data(places))[:number].reshape(-1, 3, 2)
    assert (of_groups == of_groups[:, :1]).all()
    assert len({tuple(x) for x in of_groups[:, 0]}) == len(of_groups)
    of_scenes = {tuple(x) for x in np.asarray(jax.random.key_data(keys))}
    assert len(of_scenes) == len(keys)
    assert not of_scenes & {tuple(x) for x in of_groups[:, 0]}
    plain = draw(KEY, dataclasses.replace(TINY, jmvae=JmvaeConfig()))
    assert plain[3] is None


def test_the_same_pois_stand_in_another_light():
    world = worlds.make_world(TINY)
    classes, place, keys = jnp.array([0, 1, 2]), jax.random.key(7), jax.random.split(KEY)
    draw = jax.jit(lambda key, place: worlds.random_scene(key, world, classes, place))
    one, two = (draw(key, place) for key in keys)
    for name in ("position", "yaw", "shape", "colour"):
        np.testing.assert_array_equal(getattr(one.layout, name), getattr(two.layout, name))
    assert not np.allclose(one.light.direction, two.light.direction)
    assert not np.allclose(one.poses, two.poses)
    other = draw(keys[0], jax.random.key(8))
    assert not np.allclose(one.layout.position, other.layout.position)
    np.testing.assert_array_equal(one.light.direction, other.light.direction)


def test_groups_hold_all_looks_at_one_poi():
    # 6 scenes, 2 groups of 3 looks; 4 PoIs, windows of 2 numbers.
    windows = jnp.arange(6 * 4 * 2.0).reshape(6, 4, 2)
    found = scans.grouped(windows, TINY)
    assert found.shape == (8, 3, 2)
    np.testing.assert_array_equal(found[5], windows[3:6, 1])


def test_no_label_enters_the_training(learned):
    """Other labels of the same scenes change names, and nothing that is learned."""
    surveys = learned.outputs["survey"]
    training = surveys.training
    training = dataclasses.replace(training, classes=(training.classes + 1) % 3)
    other = dataclasses.replace(surveys, training=training)
    both = surveys, other
    views = [begun(stages_of(TINY)["views"], TINY, {"survey": s}) for s in both]
    for one, two in zip(*map(jax.tree.leaves, views), strict=True):
        np.testing.assert_array_equal(one, two)
    params = learned.outputs["best_jmvae"]

    @jax.jit
    def class_beliefs(views, surveys):
        return scans.class_beliefs(KEY, TINY, params=params, views=views, surveys=surveys)

    found, renamed = (class_beliefs(v, s) for v, s in zip(views, both, strict=True))
    # Class c is now what was called c - 1 before.
    np.testing.assert_allclose(renamed.mean, jnp.roll(found.mean, 1, axis=0), atol=1e-6)


def test_encoders_are_detectors(learned):
    outputs = learned.outputs
    assert learned.is_finite
    for m, name in enumerate(("camera", "lidar")):
        encoder = outputs[f"detector_{name}"]
        bank = outputs["detections"].bank[m]
        assert bank.shape == (3, 12, 2)
        np.testing.assert_allclose(bank.sum(axis=-1), 1, rtol=1e-5)
        window = outputs["survey"].others.windows[m][0, 0]
        found = jax.eval_shape(encoder.logits, window, jnp.float32(1.0))
        assert found.shape == (3,)
        assert np.isfinite(encoder.threshold)
    grouped = outputs["grouped"]
    assert set(grouped) == {"pair", "all_looks"}
    assert all(0 <= x <= 1 for x in grouped.values())


def test_looks_for_training_are_sorted_by_what_all_looks_show(learned, monkeypatch):
    """A PoI that looks like another class goes there, whatever its label."""
    outputs, listed = learned.outputs, stages_of(TINY)
    num_bank = num_scenes(TINY)[1]
    shown = jnp.arange(num_bank * TINY.arena.num_pois).reshape(num_bank, -1) % 3
    monkeypatch.setattr(looks, "features", lambda trained, windows, distances: tuple(
        jnp.concatenate([shown, jnp.full((len(w) - num_bank, TINY.arena.num_pois), 9)])[..., None]
        for w in windows
    ))  # fmt: skip
    stage, taken_for = listed["detections"], Shown(outputs["shown"].calibrating, bank=shown)
    found = begun(stage, TINY, {**outputs, "shown": taken_for})
    for bank in found.bank:
        np.testing.assert_array_equal(bank[..., 0], np.repeat([[0], [1], [2]], 12, axis=1))


def test_a_jmvae_of_scans_needs_a_filter():
    with pytest.raises(ConfigError, match=r"jmvae.fusion = 'in_place'.*must be filter"):
        JmvaeConfig(learns_from="scans")


def test_what_all_looks_show_is_the_class_nearest_to_their_posterior(learned):
    outputs, shape = learned.outputs, make_shape(TINY)
    num_bank = num_scenes(TINY)[1]
    classes = np.asarray(outputs["class_beliefs"].mean)

    posterior = jax.jit(lambda given: leave_one_out.posterior(outputs["best_jmvae"], shape, given))
    in_frames = jax.jit(
        lambda given: tuple(
            jax.vmap(scaling)(x)
            for scaling, x in zip(outputs["views"].scalings, given, strict=True)
        )
    )

    def plain(survey, scene, poi):
        """From the three looks by each sensor at a PoI, of which `scene` is the first."""
        windows = [np.asarray(x)[scene : scene + 3, poi] for x in survey.windows]
        mean = posterior(in_frames(windows)).mean
        return np.argmin(np.sum((classes - np.asarray(mean)) ** 2, axis=1))

    shown, surveys = outputs["shown"], outputs["survey"]
    calibrating = jax.tree.map(lambda x: x[-12:], surveys.training)
    assert shown.bank.shape == (num_bank, 3)
    assert shown.calibrating.shape == (12, 3)
    for scene, poi in ((0, 0), (3, 2), (9, 1)):
        for found, survey in ((shown.bank, surveys.others), (shown.calibrating, calibrating)):
            expected = plain(survey, scene, poi)
            np.testing.assert_array_equal(found[scene : scene + 3, poi], expected)


def test_encoders_are_calibrated_with_looks_that_nothing_learned_from(learned, monkeypatch):
    """A quarter of 14 groups of scenes, rounded up: 4 groups of 3."""
    outputs, stage = learned.outputs, stages_of(TINY)["detector_camera"]
    windows = np.asarray(outputs["survey"].training.windows[0])
    num_train, _, size = windows.shape
    assert num_train == num_scenes(TINY)[0] == 42
    given = []

    def calibrate(encoder, *given_here):
        given.extend(given_here)
        return encoder

    monkeypatch.setattr(leave_one_out, "calibrate", calibrate)
    monkeypatch.setattr(supervised, "fit", lambda key, state, problem, number: (problem, ()))
    inputs = inputs_of(stage.name, TINY, outputs)
    state = stage.begin(KEY, TINY, **inputs)
    (encoder, problem), _ = stage.advance(KEY, TINY, state, **inputs)
    np.testing.assert_array_equal(given[0], windows[30:].reshape(-1, size))
    np.testing.assert_array_equal(given[1], outputs["shown"].calibrating.reshape(-1))
    np.testing.assert_array_equal(problem.shown.windows, windows[:30].reshape(-1, size))
    np.testing.assert_allclose(encoder.presence.offset, windows[:30].mean(axis=(0, 1)), rtol=1e-5)
    assert all(len(x) == 10 * TINY.arena.num_pois for x in outputs["views"].groups)


def test_without_looks_to_calibrate_with_probabilities_stay_as_they_are(learned):
    config = dataclasses.replace(TINY, detector=dataclasses.replace(TINY.detector, calibration=0.0))
    listed, outputs = stages_of(config), dict(learned.outputs)
    for name in ("shown", "detector_lidar"):
        outputs[name] = begun(listed[name], config, outputs)
    assert outputs["shown"].calibrating.shape == (0, 3)
    assert outputs["detector_lidar"][0].sharpness == 1


def test_calibration_leaves_a_group_to_learn_from():
    """Two scenes of three PoIs in one group of scenes that show the same."""
    few = DetectorConfig(num_scans=6, calibration=0.5)
    with pytest.raises(ConfigError, match=r"calibration = 0.5: leaves none of 9 scans"):
        dataclasses.replace(TINY, detector=few)
    dataclasses.replace(TINY, detector=dataclasses.replace(few, num_scans=10))


def test_no_two_starts_of_live_episodes_show_the_same_pois(monkeypatch):
    dqn = dataclasses.replace(SMOKE.dqn, observe="live", num_envs=4)
    config = dataclasses.replace(TINY, dqn=dqn)
    num_train, num_bank, num_held_out, num_empty = num_scenes(config)
    total = num_train + num_bank + num_held_out + num_empty
    group = jnp.arange(total) // 3
    windows = tuple(jnp.zeros((total, 3, 1)) for _ in range(2))
    classes, scenes = jnp.repeat(group[:, None], 3, axis=1) % 3, cast("Any", group)
    survey = Survey(classes, scenes, windows, jnp.ones((total, 2, 3)))
    monkeypatch.setattr(looks, "features", lambda trained, windows, distances: windows)

    @jax.jit
    def starts(survey):
        surveyed = divide(config, survey)
        return detections.detect(KEY, config, surveys=surveyed, trained=()).starts

    found = starts(survey)
    np.testing.assert_array_equal(found.scenes, num_train // 3 + np.arange(64))
    assert num_bank == 3 * 64  # none of those to measure on
    np.testing.assert_array_equal(found.classes[:, 0], found.scenes % 3)


REPEATING = dataclasses.replace(TINY, detector=dataclasses.replace(TINY.detector, num_repeats=30))


def test_repeated_looks_are_at_pois_of_the_bank_and_show_what_all_looks_show(learned):
    scenes, num_train = learned.outputs["scenes"], num_scenes(TINY)[0]
    _, classes, _, places = scenes
    num_bank = num_scenes(TINY)[1]
    bank = (classes[num_train : num_train + num_bank] + 1) % 3  # nowhere the true class
    found = scans.repeated(KEY, REPEATING, scenes=scenes, shown=Shown(bank[:0], bank))
    assert found.classes.shape == (30, 3)
    np.testing.assert_array_equal(found.taken_for, (found.classes[:, 0] + 1) % 3)
    groups = num_bank // 3
    assert groups < 30
    # The i-th scene shows the PoIs of the i-th group of three scenes, then the first again.
    of_scenes = jax.random.key_data(places)[num_train : num_train + num_bank]
    expected = np.asarray(of_scenes)[np.arange(30) % groups * 3]
    np.testing.assert_array_equal(jax.random.key_data(found.places), expected)


def test_novelty_learns_from_what_all_looks_show(learned, monkeypatch):
    given = {}

    def repeat(keys, world, classes, modality, number, places):
        given[modality] = classes, places
        assert number == 4  # looks in a scene
        return jnp.zeros((30, number, 2)), jnp.ones((30, number)), jnp.zeros((30, number, 2))

    def fit(found, positions, classes):
        given["fit"] = classes
        return jnp.float32(0), jnp.float32(1)

    monkeypatch.setattr(looks, "repeats", repeat)
    monkeypatch.setattr(detectors, "features", lambda *_: jnp.ones(2) / 2)
    monkeypatch.setattr(novelty, "fit", fit)
    stage, outputs = stages_of(REPEATING)["novelty"], learned.outputs
    shown = dataclasses.replace(outputs["shown"], bank=jnp.full_like(outputs["shown"].bank, 2))
    inputs = inputs_of("novelty", REPEATING, {**outputs, "shown": shown})
    stage.begin(KEY, REPEATING, **inputs)
    expected = scans.repeated(KEY, REPEATING, scenes=outputs["scenes"], shown=shown)
    np.testing.assert_array_equal(given["fit"], np.full(30, 2))
    for m in range(2):
        np.testing.assert_array_equal(given[m][0], expected.classes)
        assert (given[m][1] == expected.places).all()


def test_encoders_are_calibrated_once(learned, monkeypatch):
    """Before it learns where PoIs are: a run finishes a stage after every chunk, to check it."""
    stage = stages_of(TINY)["detector_lidar"]
    state = begun(stage, TINY, learned.outputs)
    monkeypatch.setattr(leave_one_out, "calibrate", None)
    monkeypatch.setattr(scans, "_posteriors", None)
    finish = jax.jit(lambda state, inputs: stage.finish(TINY, state, **inputs))
    found = finish(state, inputs_of(stage.name, TINY, learned.outputs))
    assert found.sharpness == learned.outputs["detector_lidar"].sharpness
    assert np.isfinite(found.threshold)
