"""The snippets of `docs/extending.md` and `docs/recorded.md` do what the pages say."""

import dataclasses
import importlib
import inspect
import re
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import random

import jaxsense
from jaxsense import PRESETS, Attribute, Config, SensorConfig, Shape, sim, train
from jaxsense.models import init

ROOT = Path(__file__).parent.parent


def snippets(page):
    text = (ROOT / "docs" / page).read_text(encoding="utf-8")
    return re.findall(r"```python\n(.*?)```", text, re.DOTALL)


PROGRAM, CLASSES, ATTRIBUTE, SENSOR, SETTINGS, LOOKS, SCORE = snippets("extending.md")
COMPARED, RETRAINED = snippets("recorded.md")


@pytest.fixture
def example(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "examples")
    return importlib.import_module


def test_a_program_trains_with_its_own_change(monkeypatch):
    given = []
    monkeypatch.setattr(train, "main", lambda **options: given.append(options["change"]))
    exec(PROGRAM, found := {"__name__": "imported"})
    assert given == []
    exec(PROGRAM, found := {"__name__": "__main__"})
    assert given == [found["change"]]


def test_classes_are_those_of_the_example(example):
    config = PRESETS["smoke"]
    found = {"config": config, "dataclasses": dataclasses, "Shape": Shape}
    exec(CLASSES, found)
    assert found["config"] == example("new_classes").change(config)


def test_a_modality_is_that_of_the_example(example):
    config = PRESETS["smoke"]
    found = {
        "dataclasses": dataclasses,
        **{"Attribute": Attribute, "Config": Config, "SensorConfig": SensorConfig},
        **{"config": config, "random": random, "sim": sim},
    }
    exec(ATTRIBUTE, found)
    found["TEMPERATURE"] = found["attributes"]["temperature"]
    exec(SENSOR, found)
    exec(SETTINGS, found)
    module = example("new_modality")
    expected = module.change(config)
    arena = dataclasses.replace(
        config.arena, attributes=found["attributes"], classes=found["classes"]
    )
    others = {name: found[name] for name in ("sensors", "modalities", "jmvae")}
    assert dataclasses.replace(config, arena=arena, **others) == expected
    ours, theirs = found["thermal"](config), module.thermal(expected)
    assert dataclasses.asdict(ours) == dataclasses.asdict(theirs)
    # The class is written out on the page; its readings are those of the example's.
    hits = SimpleNamespace(geom=np.array([0, 1, 2, 1]))
    readings = [
        sensor.read(random.key(0), hits, {"temperature": np.array([20.0, 30.0, 60.0])}, None)
        for sensor in (ours, theirs)
    ]
    np.testing.assert_array_equal(*readings)


def test_looks_fill_the_map(monkeypatch, capsys):
    config = PRESETS["smoke"]
    models = init(jax.random.key(0), config)
    monkeypatch.setattr(jaxsense, "load", lambda run: (config, models))
    camera, lidar = sim.sensors.make(config)
    of_lidar = models.detect(
        1, lidar, np.ones(len(lidar.rays.angles), np.float32), jnp.float32(0.0), jnp.float32(1.0)
    )
    scan = np.ones((len(camera.rays.angles), 3), np.float32)
    found = {"jaxsense": jaxsense, "sim": sim, "np": np, "of_lidar": of_lidar}
    found |= {"scan": scan, "bearing": 0.0, "distance": 1.0}
    exec(LOOKS, found)
    of_camera, fusion = found["detection"], models.fusion
    first = fusion.update(fusion.prior, np.zeros(2, bool), of_camera.features, 0)
    both = fusion.update(first, np.array([True, False]), of_lidar.features, 1)
    for expected, belief in zip(
        jax.tree.leaves(both), jax.tree.leaves(found["belief"]), strict=True
    ):
        np.testing.assert_allclose(belief, expected, rtol=1e-6)
    assert not np.allclose(both.mean, first.mean)
    likely = config.arena.classes[int(fusion.most_likely_class(both))]
    assert capsys.readouterr().out.strip() == likely


def arguments_of(function, snippet, names):
    """The arguments with which a snippet calls a function of the package, which must take them."""
    module, _, name = function.rpartition(".")
    module, given = importlib.import_module(module), []
    signature = inspect.signature(getattr(module, name))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, name, lambda *x, **y: given.append(signature.bind(*x, **y)))
        exec(snippet, {"jaxsense": jaxsense, **names})
    (bound,) = given
    return bound.arguments


def test_what_takes_long_gets_the_arguments_it_asks_for():
    config, models = "config", "models"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(jaxsense, "load_pretrained", lambda name: (config, models))
        score = arguments_of("jaxsense.score_missions", SCORE, {"widest": "widest"})
    assert score == {"config": config, "models": models, "policies": {"widest": "widest"}}
    compared = arguments_of("jaxsense.compare_scans", COMPARED, {})
    assert [*compared.values()] == ["runs/...", "recorded.npz"]
    given = {"key": "key", "m": 0, "windows": "windows", "labels": "labels"}
    given["models"] = init(jax.random.key(0), PRESETS["smoke"])
    retrained = arguments_of("jaxsense.vae.retrain", RETRAINED, given)
    assert retrained["key"] == "key"
    assert retrained["detector"] is given["models"].detectors[0]
    assert retrained["windows"] == "windows"
    assert retrained["labels"] == "labels"
