"""Programs of studies from the command line to JSON and table, with made-up figures."""

import json

import jax
import numpy as np
import pytest

import jaxsense
from benchmarks import curves, gate, imperfect, lost_beams, place, results, where
from benchmarks.curves import Curves

FIGURES = ("accuracy", "confidence", "looks", "time", "own", "nll", "collisions")


@pytest.fixture
def _played(monkeypatch):
    """Missions and trainings that take no time."""

    def play(self, models, policy, config=None):
        del models, config
        self.scenario.policy(policy)
        return {name: np.linspace(0.5, 1.0, 4) for name in FIGURES}

    def of_costs(key, config, models, costs):
        del key, config
        return jax.tree.map(lambda x: np.stack([x] * len(costs)), models)

    monkeypatch.setattr(Curves, "play", play)
    for module in (curves, where):
        monkeypatch.setattr(module, "of_costs", of_costs)
    shares = {name: dict.fromkeys(gate.SITUATIONS, 0.5) for name in ("camera", "lidar")}
    monkeypatch.setattr(gate, "answered", lambda *_: shares)
    monkeypatch.setattr(place, "accuracies", lambda *_: {"camera": 0.9, "lidar": 0.8})
    monkeypatch.setattr(place, "seconds_at", lambda *_: [1.0, 2.0, 3.0])


@pytest.mark.usefixtures("_played")
@pytest.mark.parametrize(
    ("program", "file", "options"),
    [
        (gate, "gate", ["--looks", "3", "--search-position", ".09"]),
        (where, "where", ["pretrained:noisy", "--episodes", "4", "--policies", "latent"]),
        (place, "place", ["pretrained:noisy"]),
        (lost_beams, "lost_beams", ["pretrained:noisy", "--looks", "8"]),
        (curves, "curves", ["pretrained:noisy", "--episodes", "4"]),
        (imperfect, "imperfect_default", ["pretrained:default", "--search-position", ".09"]),
        (imperfect, "imperfect_messages", ["pretrained:noisy", "--positions", "--headings"]),
    ],
)
def test_a_program_prints_the_tables_of_its_file(program, file, options, tmp_path, capsys):
    path = tmp_path / f"{file}.json"
    program.main([*options, "--json", str(path)])
    content = json.loads(path.read_text(encoding="utf-8"))
    printed = capsys.readouterr().out
    for name, table in results.TABLES[path.name].items():
        made = table(content)
        # A search prints its own table, and robots print all errors in one.
        if (file, name) not in {("gate", None), *((file, x) for x in ("constant", "drifts"))}:
            assert made in printed
        assert content["command"] in made
    with pytest.raises(SystemExit):
        program.main([*options, "--json", str(path)])
    assert "already exists" in capsys.readouterr().err


@pytest.mark.parametrize("way", lost_beams.WAYS)
def test_a_share_of_the_beams_is_lost(way):
    lost = lost_beams.WAYS[way](np.random.default_rng(0), (400, 50), 0.1)
    assert lost.shape == (400, 50)
    assert lost.mean() == pytest.approx(0.1, abs=0.01)
    pieces = (np.diff(lost.astype(int), axis=1, prepend=0) == 1).sum(axis=1)
    if way == "together":
        assert (pieces == 1).all()
        # In any part of the window.
        assert lost.any(axis=0).all()
    else:
        assert pieces.mean() > 3
    assert not lost_beams.WAYS[way](np.random.default_rng(0), (400, 50), 0.0).any()


def test_detectors_answer_less_where_beams_are_lost_and_gaps_stay():
    config, models = jaxsense.load_pretrained("default")
    rows = {(r["lost"], r["closed"]): r for r in lost_beams.answers(config, models, "lidar", 200)}
    assert set(rows) == {
        (way, closed) for way in ("scattered", "together") for closed in ("no", "yes")
    }
    as_read, closed = (rows["scattered", closed] for closed in ("no", "yes"))
    assert as_read["answered"][0] == closed["answered"][0] > 0.95
    assert as_read["right"][0] == closed["right"][0] > 0.99
    assert as_read["right"][3] < 0.8
    assert closed["right"][3] > 0.95
