"""Runs that are stopped and go on end with what an uninterrupted run ends with."""

import contextlib
import io
import json
import resource
import shutil
import signal
import subprocess
import sys

import pytest
from same_figures import TOLERANCES, different, numbers
from smoke import SMOKE, error_line, interrupting, without_times

import jaxsense
from jaxsense import train
from jaxsense.run.rundir import RunDirectory

# In the JMVAE, `test_seeds` stops a run.
INTERRUPTIONS = {"detector": ("detector_", 30), "dqn": ("dqn_", 40)}


@pytest.fixture(
    scope="module",
    # `test_loop` hears a stop after every chunk of any training.
    params=[("dqn",), pytest.param(("detector", "dqn"), marks=pytest.mark.slow)],
    ids="-".join,
)
def stops(request, tmp_path_factory, cache, smoke_run):
    """A run of a config, stopped in some trainings, and what was printed each time."""
    path = tmp_path_factory.mktemp("runs") / "stopped"
    few = path.with_name("few.json")  # all else is as in the preset
    few.write_text(json.dumps({"preset": "smoke", "seed": 5, "config": {"dqn": {"epochs": 60}}}))
    start = ["--config", str(few), "--quiet", "--out", str(path)]
    printed = []
    for stage, step in map(INTERRUPTIONS.__getitem__, request.param):
        printed.append(io.StringIO())
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(RunDirectory, "append_metrics", interrupting(at(stage, step)))
            before = signal.getsignal(signal.SIGINT)
            with contextlib.redirect_stderr(printed[-1]), pytest.raises(SystemExit) as stop:
                train.main([*start, *cache])
        assert signal.getsignal(signal.SIGINT) is before
        assert stop.value.code == 130
        assert not (path / "summary.json").exists()
        start = ["--resume", str(path), "--quiet"]
    return path, [each.getvalue() for each in printed]


@pytest.fixture(scope="module")
def stopped(stops):
    return stops[0]


def at(stage, step):
    """At or after a step of a stage."""
    return lambda run, name, done: name.startswith(stage) and done >= step


def steps(path, stage):
    lines = [json.loads(line) for line in (path / "metrics.jsonl").open()]
    return [line["step"] for line in lines if line["stage"] == stage]


@pytest.fixture(scope="module")
def resumed(stopped, cache):
    """A copy of the run that went on to its end, and what was printed."""
    path, printed = stopped.with_name("resumed"), io.StringIO()
    shutil.copytree(stopped, path)
    assert list((path / "checkpoints" / "unfinished").glob("dqn_*"))
    with contextlib.redirect_stdout(printed):
        train.main(["--resume", str(path), "--quiet", "--tensorboard", *cache])
    return path, printed.getvalue()


def test_a_stopped_run_goes_on_and_ends_the_same(resumed, smoke_run):
    path, printed = resumed
    assert without_times(path) == without_times(smoke_run)
    assert (path / "reward.svg").read_bytes() == (smoke_run / "reward.svg").read_bytes()
    assert not (path / "checkpoints" / "unfinished").exists()
    # Nothing was trained twice.
    for stage in ("detector_camera", "detector_lidar", "jmvae_1", "dqn_camera", "dqn_lidar"):
        assert steps(path, stage) == steps(smoke_run, stage), stage
    assert printed.splitlines() == [
        f"Results are in {path}. Start with {path / 'report.html'}.",
        f"Next: python -m jaxsense.evaluate {path} --animate",
    ]


def test_a_stopped_run_says_how_to_go_on(stops):
    path, printed = stops
    for each in printed:
        assert each.count(f"python -m jaxsense.train --resume {path}") == 1


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (shutil.rmtree, "is not a run directory: it has no config.json"),
        (lambda path: (path / "summary.json").write_text("{}"), "is finished"),
        (
            lambda path: edit(path, "versions", {"jaxsense": "0.2.0"}),
            "was written by jaxsense 0.2.0; this is 0.4.",
        ),
        (lambda path: edit(path, "versions", None), "was written by an older jaxsense"),
        (lambda path: edit(path, "seed", 7), "config.json has changed since the run began"),
    ],
)
def test_a_run_that_cannot_go_on_is_named(stopped, cache, tmp_path, capsys, change, expected):
    path = tmp_path / "run"
    shutil.copytree(stopped, path)
    change(path)
    assert expected in error_line(["--resume", str(path), *cache], capsys)


def test_a_run_goes_on_with_its_own_settings(stopped, tmp_path, capsys):
    resume = ["--resume", str(stopped)]
    for options in (["--seed", "4"], ["--dqn.epochs", "80"]):
        assert "resumes in its own settings" in error_line([*resume, *options], capsys)
    assert "resumes in its own directory" in error_line([*resume, "--out", "x"], capsys)


def test_a_run_that_is_being_written_is_left_alone(stopped, capsys):
    with RunDirectory.resume(stopped):
        assert "another process is writing to it" in error_line(["--resume", str(stopped)], capsys)


def edit(path, field, value):
    content = json.loads((path / "config.json").read_text())
    content[field] = value
    (path / "config.json").write_text(json.dumps(content))


@pytest.mark.slow  # compiles everything in a new process; see also `test_faults.py`
def test_a_full_disk_is_named_and_nothing_is_lost(smoke_run, cache, tmp_path):
    path = tmp_path / "run"

    def allow(size):
        # No file may grow larger, as if there were no room.
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))

    command = [sys.executable, "-m", "jaxsense.train", *SMOKE, *cache, "--out", str(path)]
    limited = lambda: allow(20_000)  # noqa: E731
    ended = subprocess.run(command, preexec_fn=limited, capture_output=True, text=True, check=False)
    assert ended.returncode == 2
    *of_cache, line = ended.stderr.strip().splitlines()
    assert len(of_cache) <= 1
    assert line.startswith("jaxsense.train: cannot write ")
    assert "File too large" in line
    assert line.endswith("; earlier checkpoints are intact")
    before = (path / "config.json").read_text()
    assert not (path / "summary.json").exists()
    train.main(["--resume", str(path), "--quiet", *cache])
    assert (path / "config.json").read_text() == before
    figures = without_times(path)
    figures.pop("origins", None)  # of a process that sees other devices
    assert figures == without_times(smoke_run)


def test_a_config_reproduces_its_run(resumed, smoke_run, capsys):
    path, file = resumed[0], smoke_run / "config.json"
    content = json.loads(file.read_text(encoding="utf-8"))
    assert without_times(path) == without_times(smoke_run)
    (events,) = (path / "tensorboard").iterdir()
    assert b"dqn_lidar/reward" in events.read_bytes()
    found = json.loads((path / "config.json").read_text(encoding="utf-8"))
    assert {**found, "began": 0, "digest": 0} == {**content, "began": 0, "digest": 0}
    assert content["seed"] == 5
    assert content["versions"]["jaxsense"] == jaxsense.__version__
    assert "omit --preset" in error_line(["--config", str(file), "--preset", "paper"], capsys)


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (None, "config.json cannot be read (No such file or directory)"),
        ('{"config": {"dqn"', "is not JSON"),
        ("[1]", "must hold an object"),
        ('{"colour": 1}', "colour = 1: unknown field of a run's config.json"),
        ('{"seed": 1.5}', "seed = 1.5: must be a whole number"),
        ('{"preset": "best"}', "preset = 'best': must be one of default, paper"),
        ('{"config": {"dqn": {"epoch": 3}}}', "unknown setting; did you mean dqn.epochs?"),
        ('{"config": {"arena": 3}}', "arena = 3: must be an object with names and values"),
    ],
)
def test_a_config_that_cannot_be_used_is_named(tmp_path, capsys, content, expected):
    file = tmp_path / "config.json"
    if content is not None:
        file.write_text(content)
    assert expected in error_line(["--config", str(file), "--out", str(tmp_path / "x")], capsys)
    assert not (tmp_path / "x").exists()


@pytest.mark.slow  # other programs, which are compiled for a minute
def test_a_run_on_one_thread_is_the_same_but_for_rounding(smoke_run, tmp_path):
    path = tmp_path / "run"
    train.main([*SMOKE, "--cache", "None", "--devices", "1", "--out", str(path)])
    # To the last bit with two threads here; eight, each with fewer rows, rounded differently.
    runs = [without_times(each) for each in (path, smoke_run)]
    for block, tolerance in TOLERANCES.items():
        assert not different(*(numbers(run[block]) for run in runs), tolerance)
