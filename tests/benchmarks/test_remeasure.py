"""Stored results are measured again by the commands that they hold."""

import importlib
import json
import shlex
from pathlib import Path
from types import SimpleNamespace

import pytest

from benchmarks import commands, pictures, remeasure, results
from jaxsense.run import cli

VERSIONS = {"python": "3.11.7"}


@pytest.fixture
def ran(tmp_path, monkeypatch):
    """Commands that would have run; those of `benchmarks.bad` fail, the others write their file."""
    words = []

    def run(given, env, check):
        words.append(given[1:])
        if "--json" in given:
            Path(given[given.index("--json") + 1]).write_text('{"command": "new"}')
        if "THREADS" in env:
            words.append(["THREADS", env["THREADS"]])
        return SimpleNamespace(returncode=int("benchmarks.bad" in given))

    def drawing(name):
        def draw():
            words.append([f"picture of {name}"])
            return True

        return SimpleNamespace(pictures=[f"{name}.svg"], results=(name,), trains=False, draw=draw)

    (tmp_path / "results").mkdir()
    monkeypatch.setattr(commands.subprocess, "run", run)
    monkeypatch.setattr(results, "RESULTS", tmp_path / "results")
    monkeypatch.setattr(remeasure, "device_here", lambda: "cpu")
    monkeypatch.setattr(remeasure.platform, "python_version", lambda: "3.11.9")
    monkeypatch.setattr(pictures, "DRAWINGS", tuple(map(drawing, ("gate", "where"))))
    monkeypatch.setattr(results, "main", lambda: words.append(["pages"]))
    return words


def store(name, content):
    (results.RESULTS / f"{name}.json").write_text(json.dumps(content))


def study(command, device="cpu", python="3.11.7"):
    return {"command": command, "device": device, "versions": {"python": python}}


def test_every_file_of_this_kind_of_device_is_measured_by_its_command(ran, capsys):
    store("gate", study("THREADS=1 python -m benchmarks.gate 'a run' --looks 3"))
    row = {"row": "rays", "theirs": 2.0, "device": "2 x cpu", "versions": VERSIONS}
    store("cpu", [row, {**row, "row": "jmvae", "theirs": None}])
    store("h100", [{**row, "device": "NVIDIA H100"}])
    store("tasks", [{"about": {"device": "cpu", "versions": VERSIONS}}])
    of_group = {device: {"100": {"devices": [device], "versions": VERSIONS}} for device in "ab"}
    on_cpu = {"100": {"devices": ["cpu"], "versions": VERSIONS}}
    store("seeds", {"paper": on_cpu, "raw": on_cpu, "many": of_group["a"], "team": of_group["b"]})
    remeasure.main([])
    rows, gate, threads, seeds, tasks, *drawn, pages = ran
    assert rows[:-2] == ["-m", "benchmarks", "rays", "jmvae", "--peers"]
    assert gate[:-2] == ["-m", "benchmarks.gate", "a run", "--looks", "3"]
    assert threads == ["THREADS", "1"]
    assert seeds == ["-m", "benchmarks.seeds.measure", "paper", "raw"]
    assert tasks == ["-m", "benchmarks.tasks"]
    assert drawn == [["picture of gate"], ["picture of where"]]
    assert pages == ["pages"]
    assert json.loads((results.RESULTS / "gate.json").read_text()) == {"command": "new"}
    lines = [x for x in capsys.readouterr().out.splitlines() if x.startswith("left out")]
    assert lines == [
        "left out: h100: measured on NVIDIA H100: run `python -m benchmarks rays --peers` there",
        "left out: seeds: measured on a: run `python -m benchmarks.seeds.measure many` there",
        "left out: seeds: measured on b: run `python -m benchmarks.seeds.measure team` there",
    ]


def test_files_of_another_python_and_of_missing_runs_are_left_out(ran, capsys):
    store("pipeline", study("python -m benchmarks.pipeline"))
    store("pipeline_newest", study("python -m benchmarks.pipeline", python="3.13.1"))
    store("where", study("python -m benchmarks.where", python="3.12.1"))
    store("imperfect", study("python -m benchmarks.x runs/a pretrained:b"))
    remeasure.main([])
    assert [words[1] for words in ran[:2]] == ["benchmarks.pipeline", "benchmarks.where"]
    lines = [x for x in capsys.readouterr().out.splitlines() if x.startswith("left out")]
    assert lines == [
        "left out: imperfect: needs runs/a: train it with the command of the page",
        "left out: pipeline_newest: measured with Python 3.13: run `python -m benchmarks.pipeline` "
        "with it",
    ]


def test_a_file_whose_command_fails_stays(ran):
    store("bad", study("python -m benchmarks.bad"))
    with pytest.raises(SystemExit, match="not measured: bad"):
        remeasure.main(["bad"])
    assert json.loads((results.RESULTS / "bad.json").read_text())["command"] != "new"
    assert ran[-1] == ["pages"]


def test_pictures_of_what_was_measured_are_drawn(ran):
    for name in ("gate", "bad"):
        store(name, study(f"python -m benchmarks.{name}", device="NVIDIA H100"))
    remeasure.main(["gate"])
    assert ran[1:] == [["picture of gate"], ["pages"]]


def test_unknown_files_are_told(ran, capsys):
    store("gate", study("python -m benchmarks.gate"))
    with pytest.raises(SystemExit):
        remeasure.main(["x"])
    assert "must be one of gate" in capsys.readouterr().err
    assert not ran


def test_every_stored_file_says_how_it_was_made():
    for path in results.RESULTS.glob("*.json"):
        content = json.loads(path.read_text(encoding="utf-8"))
        for each in remeasure._MADE.get(path.stem, remeasure._of_study)(path.stem, content):
            words = shlex.split(each.command)
            _, module, *options = words[words.index("python") + 1 :]
            program = importlib.import_module(module)
            if module == "benchmarks" or not hasattr(program, "Arguments"):
                program = importlib.import_module(f"{module}.__main__")
            cli.parse(module, program.Arguments, options)
            assert each.device
