"""Whole commands by two trees: what is run, what of it counts, and its table."""

import json
from pathlib import Path

import jax
import pytest

from benchmarks import measure, pipeline, results
from benchmarks.pipeline import Command, Needs
from jaxsense import init, train


@pytest.fixture
def ran(monkeypatch):
    """Words of the commands that would have run, each of which takes a second more."""
    words = []

    def run(tree, given, place):
        words.append([tree.name, *given])
        return Needs(len(words), 2.0 * len(words), 0.5)

    monkeypatch.setattr(pipeline, "run", run)
    monkeypatch.setattr(measure, "require_commit", lambda program: None)
    return words


def test_a_cold_command_runs_once_and_a_warm_one_is_the_second_with_its_cache(ran, tmp_path):
    pipeline.measured(Path("tree"), Command("x", ("module", "--quiet"), cold=True), tmp_path)
    assert len(ran) == 1
    assert pipeline.measured(Path("tree"), Command("x", ("module",)), tmp_path).seconds == 3
    first, second = ran[1:]
    assert first[:4] == second[:4] == ["tree", "module", "--cache", str(tmp_path / "cache")]
    assert first[-2] == second[-2] == "--out"
    assert first[-1] != second[-1]


def test_an_evaluation_is_of_a_run_by_the_same_tree(ran, tmp_path):
    command = Command("x", ("evaluate", "{run}"), trains=("--preset", "smoke"))
    pipeline.measured(Path("tree"), command, tmp_path)
    training, *evaluations = ran
    assert training[-2:] == ["--out", str(tmp_path / "run")]
    assert training[-6:-4] == ["--preset", "smoke"]
    assert [words[:3] for words in evaluations] == 2 * [["tree", "evaluate", str(tmp_path / "run")]]
    # Of the same seed, the second would have nothing left to write.
    assert [words[-2:] for words in evaluations] == [["--seed", "1"], ["--seed", "2"]]


def test_the_policies_of_the_run_play_among_as_many_pois_as_the_evaluation_has():
    trains = pipeline.COMMANDS["missions"].trains
    assert trains is not None
    config = train.parse([*trains]).config
    learned = jax.eval_shape(lambda: init(jax.random.key(0), config))
    assert learned.agent.plays(16)


def test_pairs_take_turns_at_being_first_and_the_median_of_their_ratios_counts(
    ran, tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(pipeline, "unpack", lambda commit, folder: None)
    out = tmp_path / "pipeline.json"
    pipeline.main(["0123456789ab", "--commands", "cold", "--json", str(out)])
    now = pipeline.ROOT.name
    assert [words[0] for words in ran] == ["before", now, now, "before", "before", now]
    stored = json.loads(out.read_text())
    # Seconds: 1 and 2, then 4 and 3, then 5 and 6.
    ratios = stored["commands"]["cold"]["ratios"]
    assert ratios["seconds"] == {"pairs": [2.0, 0.75, 1.2], "median": 1.2}
    assert ratios["cpu_s"] == ratios["seconds"]
    assert ratios["memory_gib"] == {"pairs": [1.0, 1.0, 1.0], "median": 1.0}
    line = (
        "| `train`, cold | 4.0 | 3.0 | 1.20 (0.75 to 2.00) | 8 | 6 | 1.20 (0.75 to 2.00) "
        "| 0.50 | 0.50 | 1.00 (1.00 to 1.00) |"
    )
    shown = pipeline.table({**stored, "commit": "fedcba9876543210"})
    assert line in shown
    assert "| command | seconds: 0123456789 | fedcba9876 | ratio |" in shown
    changed = pipeline.table({**stored, "commit": "fedcba9876543210", "changed": True})
    assert "; commit fedcba9876 on 20" in changed
    assert ", whose code has changed since; python" in changed
    assert pipeline.table(stored) in capsys.readouterr().out


def test_one_pair_has_no_range(ran, tmp_path, monkeypatch):
    monkeypatch.setattr(pipeline, "unpack", lambda commit, folder: None)
    out = tmp_path / "pipeline.json"
    pipeline.main(["0123456789ab", "--commands", "cold", "--pairs", "1", "--json", str(out)])
    line = "| `train`, cold | 1.0 | 2.0 | 2.00 | 2 | 4 | 2.00 | 0.50 | 0.50 | 1.00 |"
    assert line in pipeline.table(json.loads(out.read_text()))


@pytest.mark.parametrize("name", results.PIPELINE)
def test_stored_ratios_are_those_of_their_pairs(name):
    stored = json.loads((results.RESULTS / name).read_text(encoding="utf-8"))
    for found in stored["commands"].values():
        assert found["ratios"] == pipeline.ratios(found)


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["HEAD", "--commands", "warmer"], "must be one of cold, warm, team, missions, noisy"),
        (["0000000"], "commit = '0000000': fatal: "),
    ],
)
def test_what_cannot_be_measured_is_named(words, expected, capsys):
    with pytest.raises(SystemExit) as stop:
        pipeline.main(words)
    assert stop.value.code == 2
    assert expected in capsys.readouterr().err
