"""The command lines, run as a user runs them: in-process, with the smoke preset."""

import contextlib
import dataclasses
import io
import json
import os
import re
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor, wait
from pathlib import Path
from types import SimpleNamespace
from xml.etree import ElementTree

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from smoke import SMOKE, error_line

import jaxsense
from jaxsense import cli, evaluate, mission, stages, train
from jaxsense.config import PRESETS, Config, ConfigError
from jaxsense.run import devices, files, missions, programs
from jaxsense.run.compilation import Compiler, Program
from jaxsense.run.monitor import Monitor
from jaxsense.run.rundir import RunDirectory, Settings
from jaxsense.sim.world import make_world

PIPES = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
MISSION_KEYS = {
    "accuracy", "observations_per_poi", "time_s", "mean_time_s", "collisions",
    "goals_reached_fraction", "information", "episodes", "ended",
}  # fmt: skip


def test_run_directory_holds_everything(smoke_run):
    names = {path.name for path in smoke_run.iterdir()} | {".lock"}  # which may be gone
    plots = {"latent_space.png", "reward.png", "scanlines.png", "calibration.png", "policies.png"}
    others = {"config.json", "metrics.jsonl", "summary.json", "checkpoints"}
    assert names == {*others, *plots, "mission.svg", "report.html", ".lock"}
    for plot in plots:
        assert (smoke_run / plot).read_bytes()[:4] == b"\x89PNG"
    stages = {json.loads(line)["stage"] for line in (smoke_run / "metrics.jsonl").open()}
    assert {"detector_camera", "detector_lidar", "jmvae_1", "dqn_camera", "dqn_lidar"} <= stages


def test_summary_keeps_its_contract(smoke_run):
    summary = json.loads((smoke_run / "summary.json").read_text())
    assert set(summary) == {
        "preset", "seed", "versions", "devices", "timing", "detectors", "jmvae", "belief", "dqn",
        "mission",
    }  # fmt: skip
    assert summary["preset"] == "smoke"
    assert summary["seed"] == 5
    assert set(summary["timing"]) == {"total_s", "stages"}
    for stage in summary["timing"]["stages"].values():
        assert set(stage) == {"compile_s", "run_s"}
    assert set(summary["detectors"]) == {"camera", "lidar"}
    assert set(summary["detectors"]["camera"]) == {"accuracy", "ece", "nll"}
    belief = summary["belief"]
    assert belief["looks"] == [1, 2, 3, 4, 5, 6]
    for curve in ("nll", "accuracy", "bayes_nll", "bayes_accuracy"):
        assert len(belief[curve]) == 6
    assert set(belief) == {"looks", *["nll", "accuracy", "bayes_nll", "bayes_accuracy"],
                           "doubt_correlation"}  # fmt: skip
    assert -1 <= belief["doubt_correlation"] <= 1
    latent = summary["jmvae"]
    assert set(latent) == {
        "active_units", "sigma_norm", "unambiguous", "consistent", "moment_matching_error", "fusion"
    }  # fmt: skip
    for block, kind in (("sigma_norm", float), ("unambiguous", bool), ("consistent", float)):
        assert set(latent[block]) == {"joint", "camera", "lidar"}
        for values in latent[block].values():
            assert [type(value) for value in values] == [kind] * 3
    assert set(latent["fusion"]) == {"accuracy", "mean_error", "std_error"}
    for block in summary["dqn"].values():
        assert set(block) == {
            "return", "optimal", "naive", "random", "fraction_of_optimal", "one_step",
            "optimal_states", "num_states", "optimal_permutations", "num_permutations", "env_steps",
            "env_steps_per_s",
        }  # fmt: skip
        assert set(block["one_step"]) == {"policy", "optimal", "random"}
        assert block["num_states"] == 384
        assert block["env_steps"] == 60 * 32  # epochs x environments of the smoke preset
        assert block["fraction_of_optimal"] == pytest.approx(block["return"] / block["optimal"])
    assert set(summary["mission"]) == {"latent", "naive", "random", "bytes_per_detection"}
    for policy in ("latent", "naive", "random"):
        block = summary["mission"][policy]
        assert set(block) == MISSION_KEYS | ({"intervals"} if policy != "latent" else set())
        assert block["episodes"] == 4
        assert sum(block["ended"].values()) == 4
        assert block["collisions"] == 0
    # Two float32 for each of two dimensions, and one for each of two labels, against more than 1920
    # bytes of pixels or beams.
    assert summary["mission"]["bytes_per_detection"]["latent"] == 16
    assert summary["mission"]["bytes_per_detection"]["features"] == 8
    assert 1920 <= summary["mission"]["bytes_per_detection"]["raw"] <= 2732


def test_the_film_is_named_after_the_policy_that_it_shows(tmp_path, monkeypatch):
    first = dataclasses.replace(PRESETS["smoke"].mission, policies=("naive_2", "latent"))
    config, titles = dataclasses.replace(PRESETS["smoke"], mission=first), []
    monkeypatch.setattr(train.animation, "write", lambda *inputs: titles.append(inputs[-1]))
    monkeypatch.setattr(train.plots, "write_plots", lambda *inputs: None)
    monkeypatch.setattr(train.page, "write", lambda *inputs: None)
    result = SimpleNamespace(models=SimpleNamespace(class_beliefs=None), recording=None, summary={})
    with RunDirectory.create(tmp_path / "run", Settings("smoke", 0, config)) as run:
        train._write(run, result, {}, Monitor())  # pyright: ignore
    assert titles == ["naive 2 policy"]


def test_a_finished_run_is_loaded_with_its_settings(smoke_run):
    config, models = jaxsense.load(smoke_run)
    assert config == PRESETS["smoke"]
    untrained = jaxsense.init(jax.random.key(0), config)
    assert jax.tree.structure(models) == jax.tree.structure(untrained)
    kernel = models.jmvae["encoders"]["camera"]["params"]["Dense_0"]["kernel"]
    assert np.isfinite(kernel).all()
    assert not np.array_equal(
        kernel, untrained.jmvae["encoders"]["camera"]["params"]["Dense_0"]["kernel"]
    )


@pytest.mark.slow  # compiles a whole run of its own; before a release
def test_a_run_with_a_filter_trains_plays_and_is_loaded(tmp_path, cache):
    path = tmp_path / "run"
    options = "--jmvae.fusion", "filter", "--mdp.reward", "nats"
    train.main([*SMOKE, *cache, *options, "--out", str(path)])
    summary = json.loads((path / "summary.json").read_text(encoding="utf-8"))
    # The filter is hardly trained, but adds up what the looks show.
    assert summary["belief"]["accuracy"][-1] > summary["belief"]["accuracy"][0] + 0.1
    assert summary["mission"]["latent"]["accuracy"] > summary["mission"]["random"]["accuracy"]
    config, models = jaxsense.load(path)
    assert (config.jmvae.fusion, config.mdp.reward) == ("filter", "nats")
    unseen = models.jmvae["filter"]["unseen"]
    np.testing.assert_allclose(unseen.std, [20**0.5] * 2, rtol=1e-6)
    np.testing.assert_allclose(models.unseen.std, unseen.std, rtol=1e-6)


def test_another_run_is_never_overwritten(smoke_run, capsys):
    before = {path: path.stat().st_mtime_ns for path in smoke_run.rglob("*")}
    line = error_line([*SMOKE, "--out", str(smoke_run)], capsys)
    assert f"out = {str(smoke_run)!r}: is not empty; must be a new directory" in line
    assert {path: path.stat().st_mtime_ns for path in smoke_run.rglob("*")} == before


def test_training_that_turns_non_finite_stops_and_keeps_what_was_written(
    cache, tmp_path, capsys, monkeypatch
):
    run = Program.__call__

    def poisoned(self, *args):
        output = run(self, *args)
        if (self._stage, self._name) != ("jmvae", "advance"):
            return output
        state, progress = output
        return state, dataclasses.replace(progress, loss=progress.loss.at[4].set(jnp.nan))

    monkeypatch.setattr(Program, "__call__", poisoned)
    out = tmp_path / "broken"
    line = error_line([*SMOKE, *cache, "--out", str(out)], capsys)
    assert "jmvae_1: loss = nan at step 5 of 300" in line
    assert str(out) in line
    assert (out / "checkpoints" / "detector_camera.msgpack").exists()
    assert (out / "config.json").exists()
    assert not (out / "summary.json").exists()


@pytest.mark.parametrize(
    ("argv", "expected"),
    [
        (
            ["--preset", "best"],
            "preset = 'best': must be one of default, paper, noisy, team, smoke",
        ),
        (["--taste", "sweet"], "train: option = '--taste': must be one of the program"),
        (["--jmvae.hiden", "3"], "of the program; perhaps --jmvae.hidden (--help"),
        (["--arena.side", "x"], "arena.side = 'x': must be a finite number"),
        (["--seed", "-1"], "seed = -1: must be within 0 and 2^32 - 1"),
        (["--seed", "one"], "seed = 'one': must be a whole number"),
        (["--dqn.num-envs", "-4"], "dqn.num_envs = -4: must be a number greater than 0"),
        (["--dqn.observe", "ideal"], "'ideal'"),
        (["--jmvae.hidden", "64", "0"], "jmvae.hidden = (64, 0): must be one or more layer sizes"),
        (["--jmvae.beta", "nan"], "jmvae.beta = nan: must be a finite number"),
        (["--modalities"], "modalities = (): must name 1 to 8 of camera, lidar"),
        (["--modalities", "sonar"], "modalities = ('sonar',): must be some of camera, lidar"),
        (["--arena.num-pois", "50"], "arena.num_pois = 50: at most"),
        (["--arena.classes", "pink cube"], "'pink cube' must be"),
        (["--dqn.replay-capacity", "1000"], "dqn.replay_capacity = 1000: must be a multiple of"),
        (["--lidar.window", "700"], "lidar.window = 700: at most 683 of 683 rays fit"),
    ],
)
def test_bad_options_are_named_in_one_line(argv, expected, capsys, tmp_path):
    out = tmp_path / "out"
    assert expected in error_line([*argv, "--out", str(out)], capsys)
    assert not out.exists()


def test_a_place_that_cannot_be_written_is_named(tmp_path, capsys):
    file = tmp_path / "file"
    file.write_text("kept")
    line = error_line(["--preset", "smoke", "--out", str(file / "run")], capsys)
    assert f"out = {str(file / 'run')!r}: cannot be written" in line
    assert file.read_text() == "kept"


def test_help_explains_every_field(capsys):
    with pytest.raises(SystemExit) as stop:
        train.main(["--help"])
    assert stop.value.code == 0
    text = " ".join(capsys.readouterr().out.split())
    for option in ("--preset", "--seed", "--out", "--arena.side", "--dqn.epsilon-decay"):
        assert option in text
    assert "in metres" in text


def test_whoever_reads_the_help_may_stop_reading():
    code = "from jaxsense import cli, train; cli.run(lambda: train.main(['--help']))"
    with subprocess.Popen([sys.executable, "-c", code], **PIPES) as process:
        process.stdout.close()
        assert process.stderr.read() == b""
    assert process.returncode in (0, 141)


def test_every_setting_has_a_sentence_of_help():
    import ast
    import dataclasses
    import inspect

    def within(section):
        parts = [f.type for f in dataclasses.fields(section) if dataclasses.is_dataclass(f.type)]
        return [*parts, *(inner for part in parts for inner in within(part))]

    sections = within(Config)
    assert {"DqnConfig", "TravelConfig"} <= {section.__name__ for section in sections}
    for section in sections:
        (node,) = ast.parse(inspect.getsource(section)).body
        for field, following in zip(node.body, node.body[1:], strict=False):
            if isinstance(field, ast.AnnAssign):
                assert isinstance(following, ast.Expr), f"{node.name}.{ast.unparse(field)}"


def test_presets_are_configurations():
    assert set(PRESETS) == {"default", "paper", "noisy", "team", "smoke"}
    assert all(isinstance(preset, Config) for preset in PRESETS.values())
    assert PRESETS["default"].dqn.observe == "live"
    assert PRESETS["paper"].dqn.observe == "bank"
    assert (PRESETS["paper"].jmvae.alpha, PRESETS["paper"].jmvae.beta) == (1.0, 0.1)
    assert (PRESETS["paper"].dqn.epochs, PRESETS["paper"].dqn.num_envs) == (2000, 512)


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


def test_evaluate_writes_the_mission_block_of_the_summary_and_no_other(evaluated):
    path, before, _ = evaluated
    after = json.loads((path / "summary.json").read_text())
    blocks = after.pop("mission")
    before.pop("mission")
    assert after == before
    assert set(blocks) == {*mission.POLICIES, "bytes_per_detection"}
    for policy in mission.POLICIES:
        # The policies of an untrained team may be less accurate than naive exploration.
        compared = {"of_naive"} | ({"intervals"} if policy != "latent" else set())
        assert set(blocks[policy]) | compared == MISSION_KEYS | {"seed"} | compared
        assert ("intervals" in blocks[policy]) == (policy != "latent")
        assert (blocks[policy]["episodes"], blocks[policy]["seed"]) == (1, 0)


@pytest.mark.slow  # plays twice; the next test has what is kept of a summary, without playing
def test_an_evaluation_keeps_what_another_one_has_written_meanwhile(
    evaluated, tmp_path, cache, monkeypatch
):
    path, play, is_first = tmp_path / "run", missions.Player.play, [True]
    shutil.copytree(evaluated[0], path)
    begin = ["--episodes", "7", *cache]  # a batch whose programs are there

    def meanwhile(*args):
        if is_first.pop() if is_first else False:
            evaluate.main([str(path), "--policy", "naive", "--seed", "3", *begin])
        return play(*args)

    monkeypatch.setattr(missions.Player, "play", meanwhile)
    evaluate.main([str(path), "--policy", "latent", "--seed", "4", *begin])
    blocks = json.loads((path / "summary.json").read_text(encoding="utf-8"))["mission"]
    expected = {**dict.fromkeys(mission.POLICIES, 0), "latent": 4, "naive": 3}
    assert {name: blocks[name]["seed"] for name in mission.POLICIES} == expected
    # Nothing compares policies of different arenas.
    assert not any({"intervals", "of_naive"} & set(block) for block in blocks.values())


def test_an_evaluation_waits_for_another_one_that_writes(evaluated, tmp_path):
    path = tmp_path / "run"
    shutil.copytree(evaluated[0], path)
    config, models = jaxsense.load(path)
    summary = json.loads((path / "summary.json").read_text(encoding="utf-8"))
    found = {"latent": summary["mission"]["latent"]}
    arguments = evaluate.Arguments(path, seed=7)

    def write():
        evaluate._write(arguments, (config, config), models.class_beliefs, found, None)

    with ThreadPoolExecutor(1) as executor:
        with files.locked(path, waits=False):
            writing = executor.submit(write)
            assert not wait((writing,), timeout=0.5).done
            summary["mission"]["naive"]["seed"] = 8
            (path / "summary.json").write_text(json.dumps(summary), encoding="utf-8")
        writing.result()
    blocks = json.loads((path / "summary.json").read_text(encoding="utf-8"))["mission"]
    assert (blocks["latent"]["seed"], blocks["naive"]["seed"]) == (7, 8)


def test_what_cannot_be_printed_ends_no_program(smoke_run, tmp_path):
    path = tmp_path / "röm"
    shutil.copytree(smoke_run, path)
    (path / "summary.json").unlink()
    program = """
import sys
from jaxsense import cli, train
train._train = lambda begin, arguments, run, *more: (run.path / "summary.json").write_text(
    open(sys.argv[1], encoding="utf-8").read(), encoding="utf-8")
cli.run(lambda: train.main(["--resume", sys.argv[2]]))
"""
    command = [sys.executable, "-c", program, str(smoke_run / "summary.json"), str(path)]
    environment = {**os.environ, "PYTHONIOENCODING": "ascii"}
    ended = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr
    assert "r\\xf6m" in ended.stdout
    (path / "summary.json").unlink()
    with open("/dev/full", "w", encoding="utf-8") as full:
        ended = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, check=False)
    assert (ended.returncode, ended.stderr) == (0, b"")


def test_evaluate_prints_the_comparison(evaluated):
    _, _, printed = evaluated
    for words in (
        "latent",
        "naive",
        "random",
        "accuracy",
        "goals",
        "control steps/s",
        "11 missions",  # one of each policy
    ):
        assert words in printed


def test_missions_elsewhere_have_the_settings_that_are_asked_for():
    config, path = PRESETS["smoke"], Path("run")
    arguments = evaluate.Arguments(path, side=4.0, robots=("camera", "camera", "lidar"))
    there = evaluate._elsewhere(arguments, config)
    assert (there.arena.side, there.arena.num_pois) == (4.0, 3)
    assert there.carried == ("camera", "camera", "lidar")
    assert evaluate._name(there) == "3-points-4-m-2-camera-1-lidar"
    # Also 64 robots have a name that a file may bear.
    crowd = dataclasses.replace(there, robots=("camera", "lidar") * 32)
    assert evaluate._name(crowd) == "3-points-4-m-32-camera-32-lidar"
    # However it is named, a team plays in the same arenas.
    mixed = evaluate.Arguments(path, side=4.0, robots=("camera", "lidar", "camera"))
    assert evaluate._elsewhere(mixed, config) == there
    # What is asked for is no other place if the run has it already.
    same = evaluate.Arguments(path, num_pois=3, side=3.0, robots=("lidar", "camera"))
    assert evaluate._elsewhere(same, config) == config
    # A policy for any number of points has no limit to the looks of a start.
    team = PRESETS["team"]
    partly = dataclasses.replace(
        team,
        mdp=dataclasses.replace(team.mdp, partly_seen_starts=True),
        team=dataclasses.replace(team.team, num_pois=(3, 8)),
        evaluation=dataclasses.replace(team.evaluation, num_pois=(3, 8)),
    )
    there = evaluate._elsewhere(evaluate.Arguments(path, num_pois=30, side=8.0), partly)
    assert there.arena.num_pois == 30
    with pytest.raises(
        ConfigError, match=r"arena\.num_pois = 4: the policies of this run are for 3"
    ):
        evaluate._elsewhere(evaluate.Arguments(path, num_pois=4), config)


@pytest.mark.slow  # compiles missions of three robots
def test_other_robots_play_apart_from_a_runs_own(smoke_run, tmp_path, cache):
    path = tmp_path / "run"
    shutil.copytree(smoke_run, path)
    before = json.loads((path / "summary.json").read_text(encoding="utf-8"))
    options = "--robots", "camera", "camera", "lidar", "--episodes", "3", "--animate"
    for policy in ("nearest", "camera_2_alone"):
        evaluate.main([str(path), *options, "--policy", policy, *cache])
    after = json.loads((path / "summary.json").read_text(encoding="utf-8"))
    (name, place), *others = after.pop("elsewhere").items()
    assert not others
    assert after == before
    assert name == "3-points-3-m-2-camera-1-lidar"
    assert (place["num_pois"], place["side"]) == (3, 3.0)
    assert place["robots"] == ["camera", "camera", "lidar"]
    # Of both evaluations.
    assert set(place["mission"]) == {"nearest", "camera_2_alone", "bytes_per_detection"}
    assert {"told", "ambiguous_reported"} <= set(place["mission"]["camera_2_alone"])
    film = ElementTree.parse(path / f"mission-nearest-0-{name}.svg")
    lines = {text.text for text in film.iter("{http://www.w3.org/2000/svg}text")}
    assert {"camera 1 asks", "camera 2 asks", "lidar asks"} <= lines
    assert (path / "teams.png").read_bytes()[:4] == b"\x89PNG"
    assert "with other robots" in (path / "report.html").read_text(encoding="utf-8")


def test_the_report_shows_what_was_trained_and_then_what_was_evaluated(smoke_run, evaluated):
    path, _, _ = evaluated
    for report, episodes, films in ((smoke_run, 4, 1), (path, 1, 2)):
        text = (report / "report.html").read_text()
        assert text.count("<img") == 5
        assert text.count("<use") == films
        assert f"<td>{episodes}</td>" in text


def test_the_animation_shows_the_first_mission_that_was_evaluated(evaluated, cache):
    path, _, _ = evaluated
    config, models = jaxsense.load(path)
    case = mission.cases(config)["latent"]
    # The programs with which it was evaluated.
    kept, workers = (
        cli.keep_programs("jaxsense.evaluate", Path(cache[1]), config),
        devices.start(None),
    )
    with Compiler(Monitor(), kept) as compiler:
        team, batch = mission.make_mission(config), missions.batch_of(11)
        player = missions.Player(team, compiler, batch, workers)
        played = player.play(jax.random.key(0), models, {"latent": case}, 1)
    found, recording = played.metrics["latent"], played.recording
    np.testing.assert_array_equal(found["detections"][0], recording.records.detected.sum(axis=0))
    seconds = recording.end.steps * config.mission.control_period
    assert found["time_s"][0] == pytest.approx(seconds)
    film = ElementTree.fromstring((path / "mission-latent-0.svg").read_text())
    texts = {text.text for text in film.iter("{http://www.w3.org/2000/svg}text")}
    assert {f"{seconds:.1f} s", "latent policy, seed 0"} <= texts


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (["--policy", "best"], "policy = 'best': must be one of all, policies, latent, greedy"),
        (["--episodes", "0"], "episodes = 0: must be within 1 and 100,000"),
        (["--seed", "-1"], "seed = -1: must be within 0 and 2^32 - 1"),
        (["--episode", "3"], "'--episode': must be one of the program; perhaps --episodes"),
    ],
)
def test_bad_options_of_evaluate_are_named_in_one_line(smoke_run, options, expected, capsys):
    before = (smoke_run / "summary.json").read_text()
    assert expected in error_line([str(smoke_run), *options], capsys, evaluate)
    assert (smoke_run / "summary.json").read_text() == before


def test_a_directory_without_a_finished_run_is_named(tmp_path, capsys):
    line = error_line([str(tmp_path / "none")], capsys, evaluate)
    assert f"run = {str(tmp_path / 'none')!r}: must hold a run's settings" in line
    versions = {"jaxsense": jaxsense.__version__}
    stored = {"versions": versions, "config": {"colour": 1}}
    (tmp_path / "config.json").write_text(json.dumps(stored))
    assert "colour = 1: is no setting" in error_line([str(tmp_path)], capsys, evaluate)
    (tmp_path / "config.json").write_text(json.dumps({"versions": versions}))
    line = error_line([str(tmp_path)], capsys, evaluate)
    assert "must be a finished run (there is no checkpoint 'detector_camera')" in line


NUMBERS = {
    "detector.learning-rate": "0.001",
    "jmvae.alpha": "0.3",
    "jmvae.annealing": "0.4",
    "jmvae.reconstruction-weights": "8 9",
    "mdp.min-increase": "0.1",
    "mdp.max-steps": "15",
    "dqn.discount": "0.7",
    "dqn.target-period": "7",
    "lidar.range-noise": "0.02",
    "camera.pixel-noise": "0.01",
    "viewpoint.max-bearing": "15",
    "navigation.goal-angle": "5",
    "mission.equal-values": "0.2",
    "mission.attempts": "2",
    "mission.time-limit": "2",
}


@pytest.mark.slow  # a run of its own; `test_traced_settings` is the fast companion
def test_other_numbers_need_no_other_program(smoke_run, cache, tmp_path):
    traced = Path(cache[1]) / "traced"
    before = {path.name for path in traced.iterdir()}
    options = [word for name, text in NUMBERS.items() for word in (f"--{name}", *text.split())]
    train.main([*SMOKE, *cache, *options, "--out", str(tmp_path / "run")])
    assert {path.name for path in traced.iterdir()} == before
    first, second = (
        json.loads((path / "summary.json").read_text()) for path in (smoke_run, tmp_path / "run")
    )
    for block in ("detectors", "jmvae", "dqn", "mission"):
        assert first[block] != second[block]


@pytest.mark.slow  # traces everything twice
def test_no_number_is_a_constant_of_a_program():
    config = PRESETS["smoke"]

    def changed(x):
        if isinstance(x, bool):
            return not x
        return x + 1 if isinstance(x, int) else 0.99 * (x or 0.01)

    other = jax.tree.map(changed, config)
    pairs = zip(jax.tree.leaves(config), jax.tree.leaves(other), strict=True)
    assert all(here != there for here, there in pairs)
    constants = [
        {name: set(re.findall(r"dense<.*?>", text)) for name, text in lowered(each).items()}
        for each in (config, other)
    ]
    assert len(constants[0]) > 15
    assert constants[0] == constants[1]


def test_a_size_changes_only_what_depends_on_it():
    config = PRESETS["smoke"]
    other = dataclasses.replace(config, jmvae=dataclasses.replace(config.jmvae, hidden=(32,)))
    names = "scenes", "examples", "detector_camera", "detector_lidar", "jmvae_1"
    first, second = (lowered(c, names) for c in (config, other))
    changed = {name for name, text in first.items() if second[name] != text}
    assert {name.partition("-")[0] for name in changed} == {"jmvae"}


def lowered(config, names=None):
    """The programs of a run as text, by their names; of these stages alone, and of no missions."""
    found = {}

    def compile_one(self, function, *args, **options):
        program = jax.jit(function).trace(*args)
        if names is None or self._stage.removeprefix("jmvae") in map(as_stage, names):
            found[f"{self._stage}-{self._name}"] = program.lower().as_text()
        return program.out_info

    def as_stage(name):
        return name.removesuffix("_1").removeprefix("jmvae")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Program, "compile", compile_one)
        if names is not None:
            patch.setattr(programs, "_trace_missions", lambda *_: None)
            listed = stages.stages(config)
            some = [stage for stage in listed if stage.name in {*names, "survey", "detections"}]
            patch.setattr(programs, "stages", lambda *_: some)
        with Compiler(Monitor()) as compiler:
            made = programs.compile_programs(config, make_world(config), compiler)
            for each in made.of_stages.values():
                each.shapes.result()
            if names is None:
                made.player.result()
    return found
