"""Stored results are measured again by the commands that they hold."""

import json
from pathlib import Path
from types import SimpleNamespace

import pytest

from benchmarks import remeasure, results


@pytest.fixture
def ran(tmp_path, monkeypatch):
    """Commands that would have run; those of `benchmarks.bad` fail, the others write their file."""
    words = []

    def run(given, check):
        words.append(given[1:])
        if "--json" in given:
            Path(given[given.index("--json") + 1]).write_text('{"command": "new"}')
        for option in {"--plot", "--posteriors"} & {*given}:
            Path(given[given.index(option) + 1]).write_text("picture")
        return SimpleNamespace(returncode=int("benchmarks.bad" in given))

    (tmp_path / "results").mkdir()
    (tmp_path / "figures").mkdir()
    monkeypatch.setattr(remeasure.subprocess, "run", run)
    monkeypatch.setattr(results, "RESULTS", tmp_path / "results")
    monkeypatch.setattr(remeasure, "FIGURES", tmp_path / "figures")
    monkeypatch.setattr(results, "main", lambda: words.append(["pages"]))
    return words


def store(name, content):
    (results.RESULTS / f"{name}.json").write_text(json.dumps(content))


def test_every_file_of_this_kind_of_device_is_measured_by_its_command(ran):
    store("gate", {"command": "python -m benchmarks.gate 'a run' --looks 3", "device": "cpu"})
    row = {"row": "rays", "theirs": 2.0, "device": "2 x cpu"}
    store("cpu", [row, {**row, "row": "jmvae", "theirs": None}])
    store("h100", [{**row, "device": "NVIDIA H100"}])
    store("seeds", {})
    remeasure.main([])
    rows, gate, pages = ran
    assert rows[:-2] == ["-m", "benchmarks", "rays", "jmvae", "--peers"]
    assert gate[:-2] == ["-m", "benchmarks.gate", "a run", "--looks", "3"]
    assert pages == ["pages"]
    assert json.loads((results.RESULTS / "gate.json").read_text()) == {"command": "new"}


def test_a_file_whose_command_fails_stays(ran):
    store("bad", {"command": "python -m benchmarks.bad", "device": "cpu"})
    with pytest.raises(SystemExit, match="not measured: bad"):
        remeasure.main(["bad"])
    assert json.loads((results.RESULTS / "bad.json").read_text())["command"] != "new"
    assert ran[-1] == ["pages"]


def test_pictures_are_drawn_of_what_was_measured(ran):
    for name in ("curves", "imperfect_noisy", "imperfect_messages", "raw_ratio", "raw_depth"):
        store(name, {"command": f"python -m benchmarks.{name}", "device": "cpu"})
    remeasure.main([])
    assert sorted(x.name for x in remeasure.FIGURES.iterdir()) == [
        "imperfect.svg", "imperfect_drift.svg", "imperfect_messages.svg", "noisy_curves.svg",
        "raw_ablation.svg", "raw_posteriors.svg",
    ]  # fmt: skip
    # One picture of several files is drawn once.
    assert sum("benchmarks.raw.report" in words for words in ran) == 2


@pytest.mark.parametrize(
    ("name", "expected"), [("x", "must be one of seeds"), ("seeds", "train and evaluate as")]
)
def test_what_no_single_command_makes_is_told(ran, name, expected, capsys):
    store("seeds", {})
    with pytest.raises(SystemExit):
        remeasure.main([name])
    assert expected in capsys.readouterr().err
    assert not ran
