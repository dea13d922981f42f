"""Runs that are stopped or killed and go on end with what an uninterrupted run ends with."""

import contextlib
import io
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import time

import pytest
from smoke import SMOKE, error_line, interrupting, without_times
from summaries import RESULTS

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


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (shutil.rmtree, "is not a run directory: it has no config.json"),
        (lambda path: (path / "summary.json").write_text("{}"), "is finished"),
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


@pytest.mark.slow  # compiles everything in a new process
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


POINTS = {"jmvae_1": 100, "dqn_camera": 40}
"""Stages in which a run is killed, and after which step."""


def killed(path, cache, stage, step):
    """A run that is killed when it has reported a step, before its end."""
    command = [sys.executable, "-m", "jaxsense.train", *SMOKE, *cache, "--out", str(path)]
    environment = {**os.environ, "JAX_NUM_CPU_DEVICES": "2"}  # as tests have them
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stderr=pipe, text=True, env=environment) as process:
        while not has_reported(path / "metrics.jsonl", stage, step):
            assert process.poll() is None, process.stderr.read()
            time.sleep(0.01)
        process.send_signal(signal.SIGKILL)
    assert process.returncode == -signal.SIGKILL
    assert not (path / "summary.json").exists()
    return path


def has_reported(metrics, stage, step):
    if not metrics.exists():
        return False
    *whole, _ = metrics.read_text(encoding="utf-8").split("\n")
    lines = map(json.loads, whole)
    return any(line["stage"] == stage and line["step"] >= step for line in lines)


@pytest.mark.slow  # a process of its own, and a training that is compiled anew
@pytest.mark.parametrize("stage", POINTS)
def test_a_killed_run_resumes_to_the_same_summary(cache, smoke_run, tmp_path, stage):
    # `smoke_run` has filled the cache, so that most of it is training.
    path = killed(tmp_path / "run", cache, stage, POINTS[stage])
    train.main(["--resume", str(path), "--quiet", *cache])
    resumed, whole = map(without_times, (path, smoke_run))
    assert all(resumed[block] == whole[block] for block in RESULTS)
    # What came after the last checkpoint stands twice, with the same figures.
    reports = [
        set((run / "metrics.jsonl").read_text(encoding="utf-8").splitlines())
        for run in (path, smoke_run)
    ]
    assert reports[0] == reports[1]
