"""Whole commands by two trees: what is run, what of it counts, and its table."""

import json
from pathlib import Path

import jax
import pytest

from benchmarks import pipeline
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


def test_the_table_holds_medians_and_their_ratios(ran, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(pipeline, "unpack", lambda commit, folder: None)
    out = tmp_path / "pipeline.json"
    pipeline.main(["0123456789ab", "--commands", "cold", "--pairs", "3", "--json", str(out)])
    assert [words[0] for words in ran] == ["before", pipeline.ROOT.name] * 3
    line = "| `train`, cold | 3.0 | 4.0 | 1.33 | 6 | 8 | 1.33 | 0.50 | 0.50 | 1.00 |"
    shown = pipeline.table(json.loads(out.read_text()))
    assert line in shown
    assert "| command | seconds: 0123456789 | now | ratio |" in shown
    assert shown in capsys.readouterr().out


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
