"""What a mission starts with."""

import jax
import numpy as np
from teams import CONFIG

from jaxsense import mission
from jaxsense.mission import begin


def test_classes_are_drawn_from_all(monkeypatch, team, models):
    drawn = []
    monkeypatch.setattr(begin.roadmap, "build", lambda config, layout: None)
    monkeypatch.setattr(begin, "_random_poses", lambda *_: None)
    monkeypatch.setattr(begin, "start", lambda *given: drawn.append(given[3]))
    for seed in range(12):
        mission.reset(jax.random.key(seed), team, models)
    assert set(np.ravel(drawn)) == set(range(len(CONFIG.arena.classes)))
