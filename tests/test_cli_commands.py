"""`jaxsense COMMAND`: which command runs, what it says of itself, and the demo's page."""

import os
import re
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
from recordings import CONFIG, FUSION, recording
from smoke import error_line
from summaries import FOUND
from untrained import blank

import jaxsense
from jaxsense import __main__ as commands
from jaxsense import demo, export, task_list, tasks
from jaxsense.run import output
from jaxsense.run.missions import Played
from jaxsense.tasks.registry import TASKS, agents
from jaxsense.tasks.score import estimate

ROOT = Path(__file__).parents[1]


def call(*argv):
    """Runs the command in a process of its own, in which imports are told."""
    start = [sys.executable, "-X", "importtime", "-m", "jaxsense", *argv]
    return subprocess.run(start, capture_output=True, text=True, check=False)


@pytest.mark.parametrize(
    ("option", "told"),
    [("--version", f"jaxsense {jaxsense.__version__}\n"), ("--help", "usage: jaxsense COMMAND")],
)
def test_version_and_help_import_no_jax(option, told):
    done = call(option)
    assert done.returncode == 0
    assert done.stdout.startswith(told)
    imported = set(re.findall(r"\| +([\w.]+)$", done.stderr, re.MULTILINE))
    assert "jaxsense.run.version" in imported
    assert not {"jax", "numpy", "mujoco", "rich"} & imported


def run(monkeypatch, *argv, name="jaxsense"):
    """Runs the command in this process, as the console script does."""
    monkeypatch.setattr(sys, "argv", [f"/some/bin/{name}", *argv])
    commands.run()


def test_an_unknown_command_is_refused_in_one_line(monkeypatch, capsys):
    with pytest.raises(SystemExit) as stop:
        run(monkeypatch, "trian", "--seed", "1")
    assert stop.value.code == 2
    told = capsys.readouterr()
    assert told.out == ""
    known = "demo, tasks, train, evaluate, explore, export"
    assert told.err == f"jaxsense: command = 'trian': must be one of {known}\n"


def test_tasks_are_listed_with_the_returns_of_their_files(capsys):
    task_list.main([])
    text = capsys.readouterr().out
    for name in tasks.registered():
        assert f"{name}: {TASKS[name]}." in text
        for agent in agents(name):
            task = jaxsense.make(name, agent)
            assert task.agent == agent
            best, *_ = np.asarray(task.returns)
            cells = f"{agent} +{task.observation_size} +{task.num_actions} "
            cells += rf" +{estimate(best).value:.3f} {task.references[0]} "
            assert re.search(cells, text)


def test_trained_models_are_exported_by_name(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(export, "archive", lambda config, models: repr(config).encode())
    monkeypatch.chdir(tmp_path)
    export.main(["pretrained:noisy"])
    config, _ = jaxsense.load_pretrained("noisy")
    assert (tmp_path / "noisy.zip").read_text() == repr(config)
    assert "noisy.zip" in capsys.readouterr().out
    line = error_line(["pretrained:paper"], capsys, export)
    assert "preset = 'paper': must be one of default" in line
    line = error_line(["pretrained:noisy"], capsys, export)
    assert "out = 'noisy.zip': already exists" in line
    assert [path.name for path in tmp_path.iterdir()] == ["noisy.zip"]


class Player:
    """Plays a mission that was never played, in place of `missions.Player`."""

    def __init__(self, scenario, compiler, total):
        assert total == 2

    def play(self, key, models, played, episodes):
        assert episodes == 1
        metrics = dict.fromkeys(played, jax.tree.map(lambda x: x[:1], FOUND))
        return Played(metrics, dict.fromkeys(played, recording()), 60)


@pytest.fixture(scope="module")
def models():
    return blank(CONFIG)


@pytest.fixture
def played(models, monkeypatch, tmp_path):
    """Directory in which the demo plays missions of `smoke` that cost nothing."""

    def load(preset):
        jaxsense.load_pretrained(preset)
        return CONFIG, Shown(models)

    monkeypatch.setattr(demo, "load_pretrained", load)
    monkeypatch.setattr(demo.missions, "Player", Player)
    monkeypatch.chdir(tmp_path)
    return tmp_path


class Shown:
    """Models whose map is that of the recording."""

    def __init__(self, models):
        self.models, self.fusion = models, FUSION

    def __getattr__(self, name):
        return getattr(self.models, name)


NO_CACHE = ["--cache", "none", "--no-browser"]


def test_the_demo_writes_one_page_with_both_films(played, capsys):
    demo.main(NO_CACHE)
    (page,) = played.glob("runs/*/*")
    assert re.fullmatch(r"runs/\d{8}-\d{6}-demo-default/demo\.html", str(page.relative_to(played)))
    text = page.read_text()
    (films,) = re.findall('<figure class="films">.*</svg>', text, re.DOTALL)
    assert films.count('<svg class="film"') == 2
    assert {*re.findall(r"(\w+) policy", films)} == {"latent", "naive"}
    again = "python -m jaxsense.demo --preset default --seed 3", 'load_pretrained("default")'
    about = "one mission of many", "under <i>What learning is worth</i>"
    for each in (*again, *about, '<th scope="row">naive</th>'):
        assert each in text
    assert re.search(r'<th scope="row">latent</th>\s*<td>.*0\.667', text)
    told = capsys.readouterr().out
    assert "This is one mission of many; averages: README, What learning is worth.\n" in told
    assert f"The page is {page.relative_to(played)}.\n" in told
    assert "Next: python -m jaxsense tasks\n" in told
    demo.main(NO_CACHE)
    assert len([*played.glob("runs/*/demo.html")]) == 2


@pytest.mark.parametrize(
    ("argv", "error"),
    [
        (["--preset", "paper"], "preset = 'paper': must be one of default, noisy"),
        (["--policy", "best"], "policy = 'best': must be one of latent"),
        (["--seed", "-1"], "seed = -1: must be a whole number, from 0 to 4,294,967,295"),
        (["--out", "full"], "out = 'full': is not empty; must be a new or empty directory"),
        (["--out", "full/file"], "full/file: cannot be used (File exists)"),
        (["--cache", "full/file"], "cache = 'full/file': must be a directory"),
    ],
)
def test_the_demo_refuses_what_it_cannot_do_and_changes_nothing(played, capsys, argv, error):
    (played / "full").mkdir()
    (played / "full" / "file").write_text("precious")
    assert f"jaxsense.demo: {error}" in error_line([*NO_CACHE, *argv], capsys, demo)
    assert sorted(path.name for path in played.rglob("*")) == ["file", "full"]


@pytest.mark.slow  # compiles the programs of missions
def test_the_demo_plays_a_mission_of_trained_robots(tmp_path):
    command = [sys.executable, "-m", "jaxsense", "demo", "--no-browser", "--out", "here"]
    command += ["--preset", "default", "--cache", str(tmp_path / "cache")]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    text = (tmp_path / "here" / "demo.html").read_text()
    assert re.search(r'<th scope="row">latent</th>\s*<td>(<b>)?1\.000', text)


@pytest.mark.parametrize(
    ("error", "told"),
    [
        (MemoryError("Unable to allocate 8. EiB"), "Unable to allocate 8. EiB"),
        (
            jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: 400 bytes.\nMore"),
            "RESOURCE_EXHAUSTED: 400",
        ),
    ],
)
def test_a_program_without_enough_memory_ends_in_one_line(error, told, monkeypatch, capsys):
    def main():
        raise error

    monkeypatch.setattr(os, "_exit", sys.exit)
    with pytest.raises(SystemExit) as stop:
        output.run(main)
    (line,) = capsys.readouterr().err.splitlines()
    assert stop.value.code == 1
    assert line.startswith(f"Not enough memory: lower the sizes in the settings ({told}")
