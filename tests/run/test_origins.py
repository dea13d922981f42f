"""What made figures: named with them, and told where several made the figures of one run."""

import json
import shutil

import pytest
from smoke import without_times

from jaxsense import train
from jaxsense.config import PRESETS, ConfigError
from jaxsense.run import rundir, version
from jaxsense.run.rundir import RunDirectory
from jaxsense.run.settings import Settings
from jaxsense.summary import compare

THIS = {
    "versions": {"jaxsense": "0.4.0", "python": "3.11.7", "jax": "0.10.2"},
    "devices": ["cpu"],
    "cores": 2,
    "source": "aa",
    "commit": "bb",
}
OTHERS = {
    "code": ({**THIS, "source": "cc"}, "source cc and aa"),
    "commit": ({**THIS, "commit": "dd"}, "commit dd and bb"),
    "Python": (
        {**THIS, "versions": {**THIS["versions"], "python": "3.13.0"}},
        "python 3.13.0 and 3.11.7",
    ),
    "JAX": (
        {**THIS, "versions": {**THIS["versions"], "jax": "0.11.2"}},
        "jax 0.11.2 and 0.10.2",
    ),
    "processor": ({**THIS, "devices": ["NVIDIA H200"]}, "devices ['NVIDIA H200'] and ['cpu']"),
}


@pytest.mark.parametrize(("other", "words"), OTHERS.values(), ids=OTHERS)
def test_origins_differ_in_code_versions_and_machine_and_not_in_days(other, words):
    dated = {**THIS, "date": "2026-11-28"}
    assert compare.differences_of([THIS, dated]) == {}
    assert compare.several_origins([dated, THIS, THIS]) is None
    (values,) = compare.differences_of([other, THIS, THIS, other]).values()
    assert values[0] == values[3] != values[1] == values[2]
    assert words.endswith(f" {values[0]} and {values[1]}")
    told = f"Stages of this run were made with different {words}."
    assert compare.several_origins([other, dated, other]) == told


def begun(path, origin, monkeypatch):
    """A run of which another process has trained one stage and a part of the next."""
    monkeypatch.setattr(rundir, "_process", lambda: origin)
    with RunDirectory.create(path, Settings("smoke", 0, PRESETS["smoke"])) as run:
        for name in ("curves_detector_camera", "detector_camera", *["unfinished/jmvae_1"] * 2):
            run.checkpoints.save(name, {"x": 1.0})
    monkeypatch.setattr(rundir, "_process", lambda: THIS)


def test_each_stage_is_signed_by_all_that_made_it(tmp_path, monkeypatch):
    other, _ = OTHERS["code"]
    begun(tmp_path / "run", other, monkeypatch)
    first = [{**other, "stage": "detector_camera"}, {**other, "stage": "jmvae_1"}]
    with RunDirectory.resume(tmp_path / "run") as run:
        assert run.made("mission") == [*first, {**THIS, "stage": "mission"}]
        run.checkpoints.save("jmvae_1", {"x": 2.0})
        then = [*first, {**THIS, "stage": "jmvae_1"}]
        assert run.made("jmvae_1") == then
    with RunDirectory.resume(tmp_path / "run") as run:
        assert run.made("jmvae_1") == then
    (tmp_path / "run" / "origins.json").write_text('[{"stage": 1}]')
    with pytest.raises(ConfigError, match=r"origins\.json"), RunDirectory.resume(tmp_path / "run"):
        pass


def test_stages_of_runs_that_were_not_signed_are_of_unknown_origin(tmp_path, monkeypatch):
    begun(tmp_path / "run", THIS, monkeypatch)
    (tmp_path / "run" / "origins.json").unlink()
    with RunDirectory.resume(tmp_path / "run") as run:
        told = compare.several_origins(run.made("mission"))
    assert "python unknown and 3.11.7" in told


@pytest.mark.slow
def test_a_run_that_others_continue_says_so(smoke_run, cache, tmp_path, capsys, monkeypatch):
    path, own = tmp_path / "run", rundir._process()
    shutil.copytree(smoke_run, path)
    (path / "summary.json").unlink()
    other = {**own, "source": "0.0.1"}
    monkeypatch.setattr(rundir, "_process", lambda: other)
    train.main(["--resume", str(path), *cache])
    told = capsys.readouterr()
    was = version.SOURCE
    sentence = f"Stages of this run were made with different source {was} and 0.0.1."
    assert told.err == f"jaxsense.train: {path}: {sentence}\n"
    assert sentence in told.out.splitlines()
    found = json.loads((path / "summary.json").read_text())
    stages = {made["stage"]: made for made in found["origins"]}
    assert {"detector_camera", "jmvae_1", "dqn_lidar", "fusion", "mission"} <= set(stages)
    assert stages.pop("mission") == {**other, "stage": "mission"}
    assert stages == {name: {**own, "stage": name} for name in stages}
    page = (path / "report.html").read_text()
    assert f"<p><b>{sentence}</b></p>" in page
    assert "<dt>dqn_lidar</dt>" in page
    changed = {"origins": found["origins"], "source": "0.0.1"}
    assert without_times(path) == {**without_times(smoke_run), **changed}
