"""What is measured with comes from scenes that nothing was trained on."""

import dataclasses
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsense import learning, observe, pipeline, programs
from jaxsense.checkpoints import Checkpoints
from jaxsense.config import PRESETS, DetectorConfig, JmvaeConfig
from jaxsense.detections import detect
from jaxsense.monitor import Monitor
from jaxsense.vae import detectors

SMOKE, KEY = PRESETS["smoke"], jax.random.key(0)
CONFIG = dataclasses.replace(
    SMOKE,
    detector=DetectorConfig(num_scans=31, num_held_out=25, steps=1),
    jmvae=JmvaeConfig(samples_per_class=10),
    dqn=dataclasses.replace(SMOKE.dqn, observe="live", num_starts=2 * SMOKE.dqn.num_envs),
)


@pytest.fixture
def surveys(monkeypatch) -> Any:
    """Surveys whose windows, and scenes, hold the key that the scene was simulated with."""

    def survey(keys, world, classes):
        key = jax.random.key_data(keys)[:, -1].astype(jnp.uint32)
        windows = jnp.broadcast_to(key[:, None, None], (*classes.shape, 1))
        return key, (windows, windows)

    monkeypatch.setattr(observe, "surveys", survey)
    return survey


def used(arrays):
    return set(np.concatenate([np.ravel(x) for x in jax.tree.leaves(arrays)]).tolist())


def survey_all():
    rows, world = programs.survey_rows(CONFIG), SimpleNamespace()
    found = programs.survey_scenes(jax.random.key(0), rows, CONFIG, world)  # pyright: ignore
    return jax.tree.map(np.asarray, found)


def test_a_run_measures_on_scenes_that_it_did_not_train_on(surveys):
    found = survey_all()
    assert len(used(found.scenes)) == sum(programs.num_scenes(CONFIG))  # no key twice

    trained_on = []
    detector = dataclasses.make_dataclass("Detector", ["params"])({})

    def begin(key, windows):
        trained_on.append(windows)
        return detector, detector

    stand_in: Any = SimpleNamespace(
        detect=lambda trained, windows: windows,
        begin_detectors=[begin, begin],
        train_detectors=[lambda key, state, *inputs: (state, np.zeros(1))] * 2,
    )
    saver: Any = None
    stages = pipeline.Stages(CONFIG, stand_in, Monitor(), Checkpoints(), saver)
    stages.train_detectors(jax.random.key(1), found)
    looks = detect(stand_in, (), found, CONFIG)

    seen, bank, held_out = used(trained_on), used(looks.train), used(looks.held_out)
    starts, classes = used(looks.starts[1]), used(looks.windows)
    assert seen.isdisjoint(bank)
    assert held_out.isdisjoint(seen | bank | starts)
    assert starts.isdisjoint(seen)
    assert classes <= held_out
    # All of them were looked at.
    assert len(seen) >= 31 / 3
    assert [x.shape[:2] for x in looks.held_out] == [(3, 9), (3, 9)]


def test_the_pure_training_measures_on_the_same_scenes(surveys, monkeypatch):
    trained_on = []

    def train(key, windows, labels, num_labels, config):
        trained_on.append(windows)
        return SimpleNamespace(), jnp.zeros(1)

    monkeypatch.setattr(learning, "_train_detector", train)
    monkeypatch.setattr(learning, "_train_jmvae", lambda key, bank, config: ({}, jnp.zeros(1)))
    monkeypatch.setattr(detectors, "detect", lambda detector, window: window)
    found = learning.learn_perception(KEY, CONFIG, SimpleNamespace())  # pyright: ignore
    seen, bank, held_out = used(trained_on), used(found.bank), used(found.held_out)
    starts, shown = used(found.starts[1]), used(found.windows)
    assert seen.isdisjoint(bank)
    assert held_out.isdisjoint(seen | bank | starts)
    assert starts.isdisjoint(seen)
    assert shown <= held_out
