"""What made figures: named with them, and told where several made the figures of one run."""

import json
import shutil

import pytest
from smoke import without_times
from summaries import OTHERS, THIS

from jaxsense import train
from jaxsense.config import PRESETS, ConfigError
from jaxsense.run import rundir, version
from jaxsense.run.rundir import RunDirectory
from jaxsense.run.settings import Settings
from jaxsense.summary import compare


def begun(path, origin, monkeypatch):
    """A run on which another process has worked."""
    monkeypatch.setattr(rundir, "process", lambda: origin)
    with RunDirectory.create(path, Settings("smoke", 0, PRESETS["smoke"])) as run:
        assert run.sign() == [origin]
        run.checkpoints.save("detector_camera", {"x": 1.0})
    monkeypatch.setattr(rundir, "process", lambda: THIS)


def test_all_who_work_on_a_run_sign_it_in_order(tmp_path, monkeypatch):
    other = OTHERS["source"]
    begun(tmp_path / "run", other, monkeypatch)
    for _ in range(2):
        with RunDirectory.resume(tmp_path / "run") as run:
            assert run.sign() == [other, THIS]
    (tmp_path / "run" / "origins.json").write_text('[{"devices": 1}]')
    with (
        pytest.raises(ConfigError, match=r"origins\.json"),
        RunDirectory.resume(tmp_path / "run") as run,
    ):
        run.sign()


def test_runs_that_were_not_signed_are_of_unknown_origin(tmp_path, monkeypatch):
    begun(tmp_path / "run", THIS, monkeypatch)
    (tmp_path / "run" / "origins.json").unlink()
    with RunDirectory.resume(tmp_path / "run") as run:
        told = compare.several_origins(run.sign())
    assert f"python unknown and {THIS['versions']['python']}" in told


@pytest.mark.slow
def test_a_run_that_others_continue_says_so(smoke_run, cache, tmp_path, capsys, monkeypatch):
    path, own = tmp_path / "run", rundir.process()
    shutil.copytree(smoke_run, path)
    (path / "summary.json").unlink()
    other = {**own, "source": "0.0.1"}
    monkeypatch.setattr(rundir, "process", lambda: other)
    train.main(["--resume", str(path), *cache])
    told = capsys.readouterr()
    was = version.SOURCE
    sentence = f"Stages of this run were made with different source {was} and 0.0.1."
    assert told.err == f"jaxsense.train: {path}: {sentence}\n"
    assert sentence in told.out.splitlines()
    found = json.loads((path / "summary.json").read_text())
    assert found["origins"] == [own, other]
    page = (path / "report.html").read_text()
    assert f"<p><b>{sentence}</b></p>" in page
    assert page.count("<dt>made with</dt>") == 2
    changed = {"origins": found["origins"], "source": "0.0.1"}
    assert without_times(path) == {**without_times(smoke_run), **changed}
