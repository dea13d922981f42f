"""The run that tests of whole programs share, and what they do with runs."""

import contextlib
import json
import os
import signal
import time

import jax
import numpy as np
import pytest

from jaxsense import train
from jaxsense.run.rundir import RunDirectory
from jaxsense.run.settings import Settings
from jaxsense.training import stages

SMOKE = ("--preset", "smoke", "--seed", "5", "--quiet")
MISSION_KEYS = {
    "accuracy", "observations_per_poi", "time_s", "mean_time_s", "collisions",
    "goals_reached_fraction", "information", "calibration", "episodes", "ended",
}  # fmt: skip


def without_times(path):
    """The summary of a run, less what is never the same."""
    summary = json.loads((path / "summary.json").read_text(encoding="utf-8"))
    del summary["timing"]
    for block in summary["dqn"].values():
        del block["env_steps_per_s"]
    return summary


def contents(path):
    """Every file and directory below a directory, with what is in it."""
    return {each: each.read_bytes() if each.is_file() else None for each in path.rglob("*")}


def save_models(run, models):
    """Saves models in the directory of a run, as if it had trained them."""

    def save(name, tree):
        # What a training finds out is NaN before it.
        run.checkpoints.save(name, jax.tree.map(np.nan_to_num, tree))

    sources = stages.sources(run.settings.config)
    jax.tree.map(save, sources, {part: getattr(models, part) for part in sources})


def written_run(path, config, models=None, **settings):
    """The directory of a run, which has trained nothing, or some models."""
    with RunDirectory.create(path, Settings("smoke", 0, config, **settings)) as run:
        if models is not None:
            save_models(run, models)
    return path


def error_line(argv, capsys, program=train):
    """Runs a program, which must end with status 2 and nothing but one line of error."""
    with pytest.raises(SystemExit) as stop:
        program.main(argv)
    assert stop.value.code == 2
    told = capsys.readouterr()
    assert told.out == ""
    (line,) = told.err.splitlines()
    assert "Traceback" not in line
    return line


def interrupting(applies):
    """Writes metrics, and presses Ctrl-C at the first report where `(run, stage, step)` holds."""
    append, pressed = RunDirectory.append_metrics, []

    def append_metrics(self, **figures):
        append(self, **figures)
        if not pressed and applies(self, figures["stage"], figures["step"]):
            pressed.append(True)
            waiting = signal.getsignal(signal.SIGINT)
            with contextlib.suppress(KeyboardInterrupt):
                os.kill(os.getpid(), signal.SIGINT)
            # The main thread hears of it; another handler waits for the next one then.
            while signal.getsignal(signal.SIGINT) is waiting:
                time.sleep(0.01)

    return append_metrics
