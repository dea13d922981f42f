"""The runs over seeds are trained, evaluated and gathered by one command."""

import json
import shlex
from pathlib import Path
from types import SimpleNamespace

import pytest
from summaries import EVALUATION, SUMMARY

from benchmarks import commands
from benchmarks.seeds import measure
from benchmarks.seeds.plan import GROUPS, Group
from jaxsense import evaluate, train
from jaxsense.run import cli

SMALL = Group("small", "smoke", range(2), {"--dqn.epochs": "10"}, ("--seed 1", "--episodes 8"))
AGAIN = Group("again", "smoke", range(1), evaluations=("--seed 2",), shares="small")


@pytest.fixture
def ran(monkeypatch):
    """Commands that would have run; those that hold a word of `fails` fail."""
    found = SimpleNamespace(words=[], fails=set())

    def run(given, env, check):
        words = given[2:]
        found.words.append(words)
        if found.fails & {*words}:
            return SimpleNamespace(returncode=1)
        if words[0] == "jaxsense.train":
            path = Path(words[words.index("--resume" if "--resume" in words else "--out") + 1])
            path.mkdir(exist_ok=True, parents=True)
            seed = int(path.name.split("-")[-1])
            written = {"preset": "smoke", "seed": seed, "commit": "0123456789"}
            (path / "config.json").write_text(json.dumps(written))
            (path / "summary.json").write_text(json.dumps({**SUMMARY, "date": "2026-11-28"}))
        else:
            (Path(words[1]) / "evaluations").mkdir(exist_ok=True)
            name = "-".join(words[2:])
            (Path(words[1]) / "evaluations" / f"{name}.json").write_text(json.dumps(EVALUATION))
        return SimpleNamespace(returncode=0)

    monkeypatch.setattr(commands.subprocess, "run", run)
    monkeypatch.setattr(measure, "GROUPS", {each.name: each for each in (SMALL, AGAIN)})
    return found


def test_what_is_finished_is_not_done_again(ran, tmp_path):
    runs, out = tmp_path / "my runs", tmp_path / "seeds.json"
    line = ["--folder", str(runs), "--out", str(out)]
    ran.fails = {"8"}
    with pytest.raises(SystemExit, match="small-1"):
        measure.main(["small", *line])
    first = str(runs / "small-0")
    assert ran.words[:3] == [
        ["jaxsense.train", "--preset", "smoke", "--seed", "0", "--dqn.epochs", "10",
         "--out", first],
        ["jaxsense.evaluate", first, "--seed", "1"],
        ["jaxsense.evaluate", first, "--episodes", "8"],
    ]  # fmt: skip
    assert not out.exists()
    ran.words.clear()
    ran.fails = set()
    measure.main(line)
    assert ran.words == [
        ["jaxsense.evaluate", first, "--episodes", "8"],
        ["jaxsense.evaluate", str(runs / "small-1"), "--episodes", "8"],
        ["jaxsense.evaluate", first, "--seed", "2"],
    ]
    found = json.loads(out.read_text())
    assert {name: [*of_seeds] for name, of_seeds in found.items()} == {
        "again": ["0"], "small": ["0", "1"],
    }  # fmt: skip
    assert [*found["small"]["1"]["evaluations"]] == ["--episodes-8", "--seed-1"]
    assert found["small"]["1"]["date"] == "2026-11-28"
    ran.words.clear()
    measure.main(line)
    assert not ran.words


def test_a_stopped_training_is_resumed_and_a_failed_one_is_told(ran, tmp_path):
    stopped = tmp_path / "small-0"
    stopped.mkdir()
    (stopped / "config.json").write_text("{}")
    line = ["small", "--folder", str(tmp_path), "--out", str(tmp_path / "seeds.json")]
    ran.fails = {str(tmp_path / "small-1")}
    with pytest.raises(SystemExit, match=r"not measured: .*small-1$"):
        measure.main(line)
    assert ran.words[0] == ["jaxsense.train", "--resume", str(stopped)]
    assert [*json.loads((tmp_path / "seeds.json").read_text())["small"]] == ["0"]


@pytest.mark.parametrize("group", GROUPS.values(), ids=GROUPS)
def test_the_commands_of_the_plan_have_known_options(group):
    words = shlex.split(group.train(group.seeds[0]))[3:]
    assert train.parse(words).preset == group.preset
    for words in group.evaluations:
        command = group.evaluate("RUN", words)
        cli.parse("evaluate", evaluate.Arguments, shlex.split(command)[3:])
    if group.shares is not None:
        other = GROUPS[group.shares]
        assert {*group.seeds} <= {*other.seeds}
        assert group.train(100) == other.train(100)


def test_stored_runs_are_those_of_the_plan():
    found = json.loads(measure.FILE.read_text(encoding="utf-8"))
    planned = {name: [str(seed) for seed in group.seeds] for name, group in GROUPS.items()}
    assert {name: [*of_seeds] for name, of_seeds in found.items()} == planned
