"""No code that a run's config.json names is run unless the user says so."""

import dataclasses
import sys

import pytest
from smoke import error_line, written_run

import jaxsense
from jaxsense import evaluate, export, train
from jaxsense.config import PRESETS, ConfigError, SensorConfig
from jaxsense.run.rundir import RunDirectory
from jaxsense.run.settings import read_settings, resumable

REFUSED = (
    "sensors.thermal.make = 'trap:make': names code that would be run; "
    "pass --trust (trust=True) if you trust it"
)


class SprungError(Exception):
    """The trap was imported."""


@pytest.fixture(autouse=True)
def trap(tmp_path, monkeypatch):
    """A module of somebody else's, which must not be imported."""
    (tmp_path / "trap.py").write_text("from test_trust import SprungError\nraise SprungError\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setitem(sys.modules, "test_trust", sys.modules[__name__])


def change(config):
    sensors = {"thermal": SensorConfig("trap:make", "colour")}
    return dataclasses.replace(config, sensors=sensors, modalities=("lidar", "thermal"))


@pytest.fixture
def run(tmp_path):
    """The directory of a run that names the trap."""
    return written_run(tmp_path / "run", change(PRESETS["smoke"]))


READERS = {
    "load": jaxsense.load,
    "read_settings": lambda run, **trust: read_settings(run / "config.json", **trust),
    "resume": resumable,
    "open": lambda run, **trust: RunDirectory.resume(run, **trust).__enter__(),
}


@pytest.mark.parametrize("read", READERS.values(), ids=READERS)
def test_a_run_that_names_code_is_refused(run, read):
    for trust in ({}, {"trust": False}):
        with pytest.raises(ConfigError) as error:
            read(run, **trust)
        assert str(error.value) == REFUSED


@pytest.mark.parametrize(
    ("program", "words"),
    [
        (evaluate, ["RUN"]),
        (export, ["RUN"]),
        (train, ["--resume", "RUN"]),
        (train, ["--config", "RUN/config.json"]),
    ],
)
def test_commands_need_an_option(run, program, words, capsys):
    argv = [word.replace("RUN", str(run)) for word in words]
    for more in ((), ("--no-trust",), ("--trust", "--no-trust")):
        assert REFUSED in error_line([*argv, *more], capsys, program)
    with pytest.raises(SprungError):
        program.main([*argv, "--trust"])


def test_a_run_whose_reward_is_code_is_refused(tmp_path):
    smoke = PRESETS["smoke"]
    config = dataclasses.replace(smoke, mdp=dataclasses.replace(smoke.mdp, reward="trap:make"))
    path = written_run(tmp_path / "run", config)
    with pytest.raises(
        ConfigError, match=r"mdp\.reward = 'trap:make': names code that would be run"
    ):
        jaxsense.load(path)
    with pytest.raises(SprungError):
        jaxsense.load(path, trust=True)


def test_what_the_users_own_program_names_needs_none(run, tmp_path):
    with pytest.raises(SprungError):
        train.main(["--preset", "smoke", "--out", str(tmp_path / "new")], change)
    assert not (tmp_path / "new").exists()


def test_a_seed_of_several_must_have_the_settings_of_all(tmp_path, capsys):
    path = written_run(tmp_path / "sweep", PRESETS["smoke"], num_seeds=2)
    written_run(path / "seed-0", change(PRESETS["smoke"]))
    argv = ["--resume", str(path), "--cache", "None", "--quiet"]
    assert "must have the settings of" in error_line(argv, capsys)
