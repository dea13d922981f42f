"""The command `evaluate`, run as a user runs it: in-process, on the run that tests share."""

import contextlib
import dataclasses
import io
import json
import os
import re
import shutil
from pathlib import Path
from xml.etree import ElementTree

import jax
import pytest
from smoke import MISSION_KEYS, error_line

import jaxsense
from jaxsense import dqn, evaluate, export
from jaxsense.config import PRESETS, ConfigError
from jaxsense.run import rundir
from jaxsense.run.rundir import RunDirectory
from jaxsense.run.settings import Settings


@pytest.fixture(scope="module")
def evaluated(smoke_run, tmp_path_factory, cache):
    """A copy of the run, evaluated, its summary before, and what was printed."""
    path = tmp_path_factory.mktemp("runs") / "copy"
    shutil.copytree(smoke_run, path)
    before = json.loads((path / "summary.json").read_text())
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        # As many missions as need the batch of the run, whose programs are there.
        evaluate.main([str(path), "--episodes", "1", "--policy", "policies", "--animate", *cache])
    return path, before, printed.getvalue()


NAME = "3-points-3-m-1-camera-1-lidar-seed-0-1-missions"


def read(path, name=NAME):
    return json.loads((path / "evaluations" / f"{name}.json").read_text(encoding="utf-8"))


def test_evaluate_writes_a_file_of_its_own_and_leaves_the_runs_figures(evaluated):
    path, before, _ = evaluated
    assert json.loads((path / "summary.json").read_text()) == before
    found = read(path)
    blocks, origin = found.pop("mission"), found.pop("origin")
    assert origin == rundir.origin()
    assert origin["devices"] == ["cpu"] * len(jax.devices())
    assert found == {"num_pois": 3, "side": 3.0, "robots": ["camera", "lidar"]}
    assert set(blocks) == {*dqn.POLICIES}
    for policy in dqn.POLICIES:
        compared = {"intervals"} if policy != "latent" else set()
        assert set(blocks[policy]) == MISSION_KEYS | {"seed"} | compared
        assert (blocks[policy]["episodes"], blocks[policy]["seed"]) == (1, 0)
    plot = ElementTree.parse(path / "evaluations" / f"{NAME}.svg")
    assert "PoIs wrong" in "".join(plot.getroot().itertext())


@pytest.fixture
def copy(evaluated, tmp_path):
    """A copy of the evaluated run, to be changed."""
    shutil.copytree(evaluated[0], tmp_path / "run")
    return tmp_path / "run"


def write(arguments, missions):
    config, _ = jaxsense.load(arguments.run)
    return evaluate._write(arguments, config, config, missions)


def only(blocks, *names):
    """Some cases, as another evaluation has played them."""
    return {name: blocks[name] for name in names}


def test_policies_that_play_in_the_same_arenas_share_a_file(copy):
    blocks = read(copy)["mission"]
    one = only(blocks, "nearest")
    one["nearest"]["time_s"] = 99.0
    write(evaluate.Arguments(copy, episodes=1), one)
    assert read(copy)["mission"]["nearest"]["time_s"] == 99.0
    assert set(read(copy)["mission"]) == set(blocks)
    # Of another seed, nothing is compared with them; robots that are alone are not drawn.
    alone = {"camera_alone": blocks["nearest"], **one}
    del alone["nearest"]
    write(evaluate.Arguments(copy, episodes=1, seed=3), alone)
    of_seed = NAME.replace("seed-0", "seed-3")
    found = read(copy, of_seed)["mission"]
    assert set(found) == set(alone)
    assert found["camera_alone"]["seed"] == 3
    assert not (copy / "evaluations" / of_seed).with_suffix(".svg").exists()
    page = (copy / "report.html").read_text(encoding="utf-8")
    assert page.count("Evaluation: 3 PoIs in 3 m") == 2
    assert "camera_alone" in page


@pytest.mark.parametrize("other", ["code", "JAX", "unknown"])
def test_evaluations_by_others_stand_apart(copy, other):
    before, origin = read(copy), rundir.origin()
    before["origin"] = {
        "code": {**origin, "source": "other"},
        "JAX": {**origin, "versions": {**origin["versions"], "jax": "0.0.1"}},
        "unknown": None,
    }[other]
    if other == "unknown":
        del before["origin"]
    file = copy / "evaluations" / f"{NAME}.json"
    file.write_text(json.dumps(before))
    for _ in range(2):  # the second time, among those that this code has made
        write(evaluate.Arguments(copy, episodes=1), only(before["mission"], "nearest"))
    assert json.loads(file.read_text()) == before
    apart = read(copy, f"{NAME}-2")
    assert set(apart["mission"]) == {"nearest"}
    assert apart["origin"] == origin
    assert len([*(copy / "evaluations").glob("*.json")]) == 2
    titles = re.findall(
        "<h3>Evaluation: (.*)</h3>", (copy / "report.html").read_text(encoding="utf-8")
    )
    words = {"code": "source other", "JAX": "jax 0.0.1", "unknown": "source unknown"}[other]
    ours, theirs = sorted(titles, key=len)
    assert ours == "3 PoIs in 3 m; robots: 1 camera, 1 lidar; seed 0"
    assert theirs.startswith(f"{ours}; ")
    assert f"; {words}" in theirs


def test_missions_elsewhere_have_the_settings_that_are_asked_for(capsys):
    config, anything = PRESETS["smoke"], lambda n: True

    def elsewhere(config, *arena, robots=None, plays=anything, **sizes):
        arena = evaluate.ArenaArguments(*arena, **sizes)
        return evaluate._elsewhere(
            evaluate.Arguments(Path("run"), arena=arena, robots=robots), config, plays
        )

    there = elsewhere(config, side=4.0, robots=("camera", "camera", "lidar"))
    assert (there.arena.side, there.arena.num_pois) == (4.0, 3)
    assert there.carried == ("camera", "camera", "lidar")
    assert evaluate._place(there) == "3-points-4-m-2-camera-1-lidar"
    # Also 64 robots have a name that a file may bear.
    crowd = dataclasses.replace(there, robots=("camera", "lidar") * 32)
    assert evaluate._place(crowd) == "3-points-4-m-32-camera-32-lidar"
    # However it is named, a team plays in the same arenas.
    assert elsewhere(config, side=4.0, robots=("camera", "lidar", "camera")) == there
    # What is asked for is no other place if the run has it already.
    assert elsewhere(config, 3, 3.0, robots=("lidar", "camera")) == config
    # A policy for any number of points has no limit to the looks of a start.
    team = PRESETS["team"]
    partly = dataclasses.replace(
        team,
        mdp=dataclasses.replace(team.mdp, partly_seen_starts=True),
        team=dataclasses.replace(team.team, num_pois=(3, 8)),
        evaluation=dataclasses.replace(team.evaluation, num_pois=(3, 8)),
    )
    assert elsewhere(partly, 30, 8.0).arena.num_pois == 30
    assert "30 PoIs: the Q-network learns with 3 to 8" in capsys.readouterr().err
    assert elsewhere(partly, 8, 8.0, robots=("lidar",) * 3).arena.num_pois == 8
    assert "3 robots with lidar: the Q-network learns with 1 to 2" in capsys.readouterr().err
    assert not capsys.readouterr().err
    with pytest.raises(ConfigError, match=r"arena\.num_pois = 4: must be 3, as in training"):
        elsewhere(config, 4, plays=lambda n: n == 3)


@pytest.mark.slow  # compiles missions of three robots
def test_other_robots_play_apart_from_a_runs_own(smoke_run, tmp_path, cache):
    path = tmp_path / "run"
    shutil.copytree(smoke_run, path)
    options = "--robots", "camera", "camera", "lidar", "--episodes", "3", "--animate"
    for policy in ("nearest", "camera_2_alone"):
        evaluate.main([str(path), *options, "--policy", policy, *cache])
    (file,) = (path / "evaluations").glob("*.json")
    assert file.stem == "3-points-3-m-2-camera-1-lidar-seed-0-3-missions"
    found = read(path, file.stem)
    assert (found["num_pois"], found["side"]) == (3, 3.0)
    assert found["robots"] == ["camera", "camera", "lidar"]
    # Of both evaluations.
    assert set(found["mission"]) == {"nearest", "camera_2_alone"}
    assert {"told", "ambiguous_reported"} <= set(found["mission"]["camera_2_alone"])
    drawn = ElementTree.parse(path / "mission-nearest-0-3-points-3-m-2-camera-1-lidar.svg")
    lines = {text.text for text in drawn.iter("{http://www.w3.org/2000/svg}text")}
    assert {"camera 1: choosing", "camera 2: choosing", "lidar: choosing"} <= lines
    assert "2 camera, 1 lidar" in (path / "report.html").read_text(encoding="utf-8")


def test_a_directory_without_a_finished_run_is_named(tmp_path, capsys):
    line = error_line([str(tmp_path / "none")], capsys, evaluate)
    assert f"{tmp_path / 'none'}': is not a run directory: it has no config.json" in line
    (tmp_path / "config.json").write_text(json.dumps({"versions": {"jaxsense": "0.1.0"}}))
    assert "was written by jaxsense 0.1.0" in error_line([str(tmp_path)], capsys, evaluate)
    with RunDirectory.create(tmp_path / "run", Settings("smoke", 0, PRESETS["smoke"])) as run:
        pass
    line = error_line([str(run.path)], capsys, evaluate)
    assert "detector_camera.msgpack': is missing; must be that of a finished run" in line


@pytest.mark.parametrize("program", [evaluate, export])
def test_the_latest_run_is_the_newest_finished_one_in_runs(program, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for number, name in enumerate(["second", "third", "first", "unfinished"]):
        run = tmp_path / "runs" / name
        run.mkdir(parents=True)
        (run / "config.json").write_text("{}")
        began = {"first": 1, "second": 2, "third": 3, "unfinished": 4}[name]
        os.utime(run / "config.json", (began, began))
        if name != "unfinished":
            (run / "summary.json").write_text("{}")
            os.utime(run / "summary.json", (10 - number, 10 - number))
    line = error_line(["latest"], capsys, program)
    older = "run = 'runs/third': was written by an older jaxsense"
    assert older in line
    with pytest.raises(ConfigError, match=older):
        jaxsense.load("latest")
    assert jaxsense.load("pretrained:noisy")[0] == jaxsense.load_pretrained("noisy")[0]
    # A directory of that name comes first.
    Path("latest").mkdir()
    assert "'latest': is not a run directory" in error_line(["latest"], capsys, program)
