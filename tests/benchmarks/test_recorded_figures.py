"""Looks through real scans, with a detector that was trained on few simulated ones."""

from dataclasses import replace

import jax
import numpy as np
import pytest

import jaxsense
from benchmarks import recorded
from jaxsense.config import PRESETS
from jaxsense.interfaces import rawlog
from jaxsense.training import learn

pytestmark = pytest.mark.skipif(
    not rawlog.DIRECTORY.exists(), reason="mrpt-common is not installed"
)


def figures_of(preset, every):
    """Figures of a LiDAR's detector through some of the scans."""
    config = PRESETS[preset]
    train = jax.jit(
        lambda key: learn(key, config, until="detector_lidar").outputs["detector_lidar"]
    )
    models = jaxsense.init(jax.random.key(0), config)
    models = replace(models, detectors=(models.detectors[0], train(jax.random.key(1))))
    scans = rawlog.read_logs()
    scans = replace(scans, ranges=scans.ranges[::every])
    return recorded.figures(config, models, scans)


def share(figures, *words):
    """The only figure whose name holds all words."""
    (found,) = (x for name, x in figures.items() if all(word in name for word in words))
    return found


@pytest.mark.slow
def test_nothing_is_found_in_real_scans_and_pois_are(monkeypatch):
    monkeypatch.setattr(recorded, "_RETRAINED", 1)
    found = figures_of("smoke", every=8)
    assert np.isfinite([*found.values()]).all()
    assert share(found, "random distance, 880 looks") < 0.03
    assert share(found, "PoI, 8", "passes") > 0.9
    assert share(found, "of those that pass") > 0.9
    assert (
        share(found, "5 cm too far", "after") > share(found, "5 cm too far", "shape right") + 0.05
    )


@pytest.mark.slow
def test_encoders_that_learn_without_labels_are_not_retrained_with_them(monkeypatch):
    monkeypatch.setattr(recorded, "_RETRAINED", 1)
    config, scans = PRESETS["raw"], rawlog.read_logs()
    models = jaxsense.init(jax.random.key(0), config)
    found = recorded.figures(config, models, replace(scans, ranges=scans.ranges[::16]))
    assert np.isfinite([*found.values()]).all()
    assert len([name for name in found if "shape right" in name]) == 4
    assert not [name for name in found if "retrain" in name]


@pytest.mark.slow  # trains a detector of `default`
def test_default_keeps_its_figures_in_real_scans():
    found = figures_of("default", every=1)
    assert share(found, "random distance, 7,040 looks") <= 0.02
    assert share(found, "of those that pass") >= 0.97
    assert share(found, "half of the scans", "after") >= 0.985
