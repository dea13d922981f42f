"""What becomes of runs that something happens to; see `docs/faq.md`."""

import json
import subprocess
import sys

import pytest

from benchmarks import measure
from benchmarks.faults import __main__ as faults
from benchmarks.faults.runs import Runs, require
from benchmarks.faults.table import table


@pytest.fixture
def trials(monkeypatch):
    """Three trials of two faults, one of which ends otherwise than it must."""
    monkeypatch.setattr(Runs, "whole", lambda *_: {})
    found = [
        ("a fault", lambda: require(True, "")),
        ("another fault", lambda: require(False, "status 1")),
        ("a fault", lambda: None),
    ]
    monkeypatch.setattr(faults, "trials", lambda *_: iter(found))


def test_faults_are_counted_and_stored(trials, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(measure, "require_commit", lambda _: None)
    path = tmp_path / "faults.json"
    assert not faults.main(["--json", str(path)])
    (results,) = json.loads(path.read_text(encoding="utf-8"))
    assert results["command"] == "python -m benchmarks.faults"
    assert results["passed"] == {"a fault": [True, True], "another fault": [False]}
    printed = capsys.readouterr()
    assert printed.err == "another fault: BrokenError: status 1\n"
    assert printed.out == table([results]) + "\n"
    assert "| a fault | 2 of 2 |\n| another fault | 0 of 1 |\n" in printed.out


def test_faults_that_are_tried_again_replace_their_rows(trials, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(measure, "require_commit", lambda _: None)
    path = tmp_path / "faults.json"
    faults.main(["--json", str(path)])
    monkeypatch.setattr(faults, "trials", lambda *_: iter([("another fault", lambda: None)]))
    with pytest.raises(SystemExit):
        faults.main(["--json", str(path)])
    assert "already exists" in capsys.readouterr().err
    assert faults.main(["--only", "another", "--json", str(path)])
    results = json.loads(path.read_text(encoding="utf-8"))
    shown = table(results)
    assert "| a fault | 2 of 2 |\n| another fault | 1 of 1 |\n" in shown
    assert "`python -m benchmarks.faults --only another`: " in shown


def test_only_the_chosen_faults_are_tried(trials, capsys):
    assert faults.main(["--only", "a fault"])
    assert "another" not in capsys.readouterr().out


@pytest.mark.slow  # some 40 minutes, as `benchmarks.faults` does
@pytest.mark.timeout(3 * 3600)
def test_all_faults_end_as_they_must(capsys):
    with capsys.disabled():
        subprocess.run([sys.executable, "-m", "benchmarks.faults"], check=True)
