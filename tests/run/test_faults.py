"""Runs that are killed, poisoned or damaged; `test_resume` stops them and fills a disk."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time

import pytest
from smoke import SMOKE, without_times
from summaries import RESULTS

from jaxsense import train

pytestmark = pytest.mark.slow  # processes of their own, and a training that is compiled anew
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


@pytest.fixture(scope="module", params=POINTS)
def stopped(request, tmp_path_factory, cache, smoke_run):
    """A killed run; `smoke_run` has filled the cache, so that most of it is training."""
    path = tmp_path_factory.mktemp("killed") / request.param
    return killed(path, cache, request.param, POINTS[request.param])


def check_resumed(path, cache, smoke_run):
    train.main(["--resume", str(path), "--quiet", *cache])
    resumed, whole = map(without_times, (path, smoke_run))
    assert all(resumed[block] == whole[block] for block in RESULTS)
    metrics = (path / "metrics.jsonl").read_text(encoding="utf-8").splitlines()
    steps = [(line["stage"], line["step"]) for line in map(json.loads, metrics) if "loss" in line]
    assert len(set(steps)) == len(steps)


def test_a_killed_run_resumes_to_the_same_summary(stopped, cache, smoke_run, tmp_path):
    path = tmp_path / "run"
    shutil.copytree(stopped, path)
    check_resumed(path, cache, smoke_run)


def test_a_damaged_checkpoint_is_named_in_one_line(stopped, cache, smoke_run, tmp_path, capsys):
    path = tmp_path / "run"
    shutil.copytree(stopped, path)
    target = min((path / "checkpoints").glob("detector_*.msgpack"))
    content = bytearray(target.read_bytes())
    content[len(content) // 2] ^= 1
    target.write_bytes(content)
    check_resumed(path, cache, smoke_run)
    (line,) = [x for x in capsys.readouterr().err.splitlines() if target.name in x]
    assert "is damaged" in line
