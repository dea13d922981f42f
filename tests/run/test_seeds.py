"""Several seeds in one command, each a run of its own."""

import dataclasses
import json
import shutil

import jax
import numpy as np
import pytest
from smoke import error_line, interrupting, without_times

import jaxsense
from jaxsense import evaluate, train
from jaxsense.run.compilation import RowProgram
from jaxsense.run.rundir import RunDirectory
from jaxsense.run.settings import read_settings


@pytest.fixture(scope="module")
def seeds(tmp_path_factory, cache):
    """Seeds 4 and 5, stopped while the second one learns and then gone on with."""
    path = tmp_path_factory.mktemp("runs") / "seeds"
    options = ["--preset", "smoke", "--num-seeds", "2", "--seed", "4", "--quiet", *cache]
    with pytest.MonkeyPatch.context() as patch:
        second = lambda run, stage, step: run.settings.seed == 5 and stage == "jmvae_1"  # noqa: E731
        patch.setattr(RunDirectory, "append_metrics", interrupting(second))
        with pytest.raises(SystemExit) as stop:
            train.main([*options, "--out", str(path)])
    assert stop.value.code == 130
    assert (path / "seed-4" / "summary.json").exists()
    assert not (path / "seed-5" / "summary.json").exists()
    train.main(["--resume", str(path), "--quiet", *cache])
    return path


@pytest.mark.slow
def test_a_seed_of_several_is_the_run_of_that_seed(seeds, smoke_run):
    assert without_times(seeds / "seed-5") == without_times(smoke_run)
    models = [jaxsense.load(path)[1] for path in (seeds / "seed-5", smoke_run)]
    for here, there in zip(*map(jax.tree.leaves, models), strict=True):
        np.testing.assert_array_equal(here, there)
    settings = read_settings(seeds / "seed-5" / "config.json")
    assert (settings.seed, settings.num_seeds, settings.preset) == (5, 1, "smoke")
    names = {path.name for path in (seeds / "seed-5").iterdir()}
    assert names == {path.name for path in smoke_run.iterdir()}


@pytest.mark.slow
def test_the_summary_of_several_seeds_is_over_all_of_them(seeds, capsys):
    summary = json.loads((seeds / "summary.json").read_text(encoding="utf-8"))
    each = [without_times(seeds / f"seed-{s}") for s in (4, 5)]
    accuracy = [s["detectors"]["lidar"]["accuracy"] for s in each]
    assert summary["detectors"]["lidar"]["accuracy"]["mean"] == pytest.approx(np.mean(accuracy))
    assert summary["seeds"]["4"]["mission"] == each[0]["mission"]
    assert summary["seeds"]["5"]["dqn"]["camera"]["env_steps_per_s"] > 0
    assert "failed" not in summary
    page = (seeds / "report.html").read_text(encoding="utf-8")
    assert '<a href="seed-4/report.html">4</a>' in page
    mean, low, high = (
        summary["detectors"]["lidar"]["accuracy"][n] for n in ("mean", "low", "high")
    )
    interval = f"{low:.4f}\N{NO-BREAK SPACE}to\N{NO-BREAK SPACE}{high:.4f}"
    assert f"<td>{mean:.4f} ({interval})</td>" in page
    assert page.count("<img") == 2  # the curves, and accuracy against looks
    with pytest.raises(SystemExit):
        evaluate.main([str(seeds)])
    assert "holds several seeds; choose one" in capsys.readouterr().err
    assert "is finished" in error_line(["--resume", str(seeds)], capsys)


@pytest.mark.slow
def test_a_seed_that_fails_leaves_the_others(seeds, cache, tmp_path, monkeypatch, capsys):
    path = tmp_path / "seeds"
    shutil.copytree(seeds, path)
    (path / "summary.json").unlink()
    shutil.rmtree(path / "seed-4")

    def call(self, *args):
        output = original(self, *args)
        bad = np.array(output.windows[0])
        bad[0, 0, 0] = np.nan
        return dataclasses.replace(output, windows=(bad, *output.windows[1:]))

    original = RowProgram.__call__
    monkeypatch.setattr(RowProgram, "__call__", call)  # of the survey alone
    train.main(["--resume", str(path), "--quiet", *cache])
    (line,) = capsys.readouterr().err.splitlines()
    assert "survey: results are not finite; earlier checkpoints are in" in line
    summary = json.loads((path / "summary.json").read_text(encoding="utf-8"))
    assert summary["failed"] == {"4": "survey: results are not finite"}
    assert list(summary["seeds"]) == ["5"]
    found = without_times(path / "seed-5")["detectors"]["lidar"]["accuracy"]
    assert summary["detectors"]["lidar"]["accuracy"] == {"mean": found, "low": None, "high": None}
