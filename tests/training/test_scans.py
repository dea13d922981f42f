"""A JMVAE that learns from scans: groups of looks, and labels that only name what it has found."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsense import PRESETS, Config, learn, looks, training
from jaxsense.config import ConfigError, DetectorConfig, FilterConfig, JmvaeConfig
from jaxsense.sim import world as worlds
from jaxsense.training import perception, scans
from jaxsense.training.stage import Stage
from jaxsense.vae import leave_one_out

SMOKE = PRESETS["smoke"]
TINY = dataclasses.replace(
    SMOKE,
    detector=DetectorConfig(num_scans=120, num_held_out=36, steps=2, batch=8),
    jmvae=JmvaeConfig(
        learns_from="scans", fusion="filter", looks=3, hidden=(8,), steps=2, batch=4,
        restarts=2, samples_per_class=12,
    ),
    filter=FilterConfig(steps=2, batch=4),
)  # fmt: skip
KEY = jax.random.key(0)


def stages_of(config: Config) -> dict[str, Stage]:
    return {stage.name: stage for stage in training.stages.stages(config)}


@pytest.fixture(scope="module")
def learned():
    return jax.jit(lambda key: learn(key, TINY, until="grouped"))(KEY)


def test_every_stage_follows_those_that_it_takes_from():
    names = list(stages_of(TINY))
    assert names[:11] == [
        "scenes", "survey", "examples", "views", "jmvae_1", "jmvae_2", "best_jmvae",
        "class_beliefs", "detector_camera", "detector_lidar", "detections",
    ]  # fmt: skip
    for i, stage in enumerate(stages_of(TINY).values()):
        assert set(stage.sources) <= set(names[:i])


def test_scenes_come_in_groups_that_show_the_same_pois():
    keys, classes, is_empty, places = perception.draw_scenes(KEY, TINY)
    number = sum(perception.num_scenes(TINY)[:3])
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
    plain = perception.draw_scenes(KEY, dataclasses.replace(TINY, jmvae=JmvaeConfig()))
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
    other = dataclasses.replace(surveys, classes=(surveys.classes + 1) % 3)
    listed = stages_of(TINY)
    views = [listed["views"].begin(KEY, TINY, surveys=s) for s in (surveys, other)]
    for one, two in zip(*map(jax.tree.leaves, views), strict=True):
        np.testing.assert_array_equal(one, two)
    params = learned.outputs["best_jmvae"]
    found, renamed = (
        scans.class_beliefs(KEY, TINY, params=params, views=v, surveys=s)
        for v, s in zip(views, (surveys, other), strict=True)
    )
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
        window = outputs["survey"].windows[m][0, 0]
        assert encoder.features(window).shape == (2,)
        assert np.isfinite(encoder.gate.threshold)
    grouped = outputs["grouped"]
    assert set(grouped) == {"pair", "all_looks"}
    assert all(0 <= x <= 1 for x in grouped.values())


def test_looks_for_training_are_sorted_by_what_all_looks_show(learned, monkeypatch):
    """A PoI that looks like another class goes there, whatever its label."""
    outputs, listed = learned.outputs, stages_of(TINY)
    num_bank = perception.num_scenes(TINY)[1]
    num_groups = num_bank // 3 * TINY.arena.num_pois
    shown = jnp.arange(num_groups) % 3
    monkeypatch.setattr(scans, "_shown", lambda *_: shown)
    monkeypatch.setattr(looks, "detect_all", lambda trained, windows: tuple(
        jnp.concatenate([
            jnp.repeat(shown.reshape(-1, TINY.arena.num_pois), 3, axis=0),
            jnp.full((len(w) - num_bank, TINY.arena.num_pois), 9),
        ])[..., None] for w in windows
    ))  # fmt: skip
    stage = listed["detections"]
    found = stage.begin(KEY, TINY, **stage.select(outputs))
    for bank in found.bank:
        np.testing.assert_array_equal(bank[..., 0], np.repeat([[0], [1], [2]], 12, axis=1))


def test_a_jmvae_of_scans_needs_a_filter():
    with pytest.raises(ConfigError, match=r"jmvae.fusion = 'in_place'.*must be filter"):
        JmvaeConfig(learns_from="scans")


def test_encoders_are_calibrated_once(learned, monkeypatch):
    """Before the gate is trained: a run finishes a stage after every chunk, to check it."""
    stage = stages_of(TINY)["detector_lidar"]
    inputs = stage.select(learned.outputs)
    state = stage.begin(stage.key(KEY), TINY, **inputs)
    monkeypatch.setattr(leave_one_out, "calibrate", None)
    monkeypatch.setattr(scans, "_posteriors", None)
    found = stage.finish(TINY, state, **inputs)
    assert found.sharpness == learned.outputs["detector_lidar"].sharpness
    assert np.isfinite(found.gate.threshold)
