"""Runs that are killed; `test_resume` stops them and fills a disk."""

import json
import os
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


@pytest.mark.parametrize("stage", POINTS)
def test_a_killed_run_resumes_to_the_same_summary(cache, smoke_run, tmp_path, stage):
    # `smoke_run` has filled the cache, so that most of it is training.
    path = killed(tmp_path / "run", cache, stage, POINTS[stage])
    train.main(["--resume", str(path), "--quiet", *cache])
    resumed, whole = map(without_times, (path, smoke_run))
    assert all(resumed[block] == whole[block] for block in RESULTS)
    metrics = (path / "metrics.jsonl").read_text(encoding="utf-8").splitlines()
    steps = [(line["stage"], line["step"]) for line in map(json.loads, metrics) if "loss" in line]
    assert len(set(steps)) == len(steps)
