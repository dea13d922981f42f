"""Run directories: nobody writes into that of another."""

import errno
import json
import shutil
import subprocess
from concurrent.futures import ThreadPoolExecutor
from datetime import datetime
from pathlib import Path
from types import SimpleNamespace

import pytest

from jaxsense.config import PRESETS, ConfigError
from jaxsense.run import files, rundir, version
from jaxsense.run.rundir import RunDirectory
from jaxsense.run.settings import Settings, read_settings

SETTINGS = Settings("smoke", 3, PRESETS["smoke"])


def test_runs_of_one_second_get_directories_of_their_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(rundir, "datetime", SimpleNamespace(now=lambda: datetime(2026, 11, 29)))
    with ThreadPoolExecutor(8) as executor:
        made = list(executor.map(lambda _: rundir.dated("a"), range(8)))
    name = "20261129-000000-a"
    assert sorted(path.name for path in made) == [name, *(f"{name}-{i}" for i in range(2, 9))]


def test_of_two_that_want_one_directory_the_second_is_refused(tmp_path):
    path = tmp_path / "run"
    with RunDirectory.create(path, SETTINGS) as run:
        assert read_settings(run.path / "config.json") == SETTINGS
        (path / "config.json").unlink()  # as if the first one had not yet come so far
        with (
            pytest.raises(BlockingIOError, match="another process is writing to it"),
            RunDirectory.create(path, SETTINGS),
        ):
            pass
        assert not (path / "config.json").exists()
    # A process that was killed at once leaves the lock.
    with RunDirectory.create(path, SETTINGS):
        assert {file.name for file in path.iterdir()} == {".lock", "config.json"}
    with (
        pytest.raises(ConfigError, match="is not empty; must be a new or empty directory"),
        RunDirectory.create(path, SETTINGS),
    ):
        pass


@pytest.mark.parametrize("name", ["thesis.txt", ".config.json.d/.notes.unfinished"])
def test_a_directory_of_somebody_gets_no_lock(tmp_path, name):
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_text("precious", encoding="utf-8")
    with pytest.raises(ConfigError, match="is not empty"), RunDirectory.create(tmp_path, SETTINGS):
        pass
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == [tmp_path / name]


def test_a_line_that_a_killed_process_has_left_is_cut(tmp_path):
    path = tmp_path / "run"
    with RunDirectory.create(path, SETTINGS) as run:
        run.append_metrics(stage="jmvae", step=1)
    with (path / "metrics.jsonl").open("a", encoding="utf-8") as metrics:
        metrics.write('{"stage": "jm')
    with RunDirectory.resume(path) as run:
        run.append_metrics(stage="jmvae", step=2)
    lines = (path / "metrics.jsonl").read_text(encoding="utf-8").splitlines()
    assert [json.loads(line)["step"] for line in lines] == [1, 2]


@pytest.mark.parametrize("error", [ConfigError("a", 1, "is wrong"), KeyboardInterrupt()])
def test_a_run_that_is_refused_before_it_begins_leaves_no_directory(tmp_path, error):
    def fail(path, *, begun):
        with RunDirectory.create(path, SETTINGS) as run:
            if begun:
                run.append_metrics(stage="jmvae", step=1)
            raise error

    for name, begun in (("new", False), ("begun", True)):
        with pytest.raises(type(error)):
            fail(tmp_path / name, begun=begun)
    assert [path.name for path in tmp_path.iterdir()] == ["begun"]
    assert (tmp_path / "begun" / "config.json").exists()


@pytest.mark.parametrize("was_there", [True, False])
def test_only_a_directory_that_is_new_is_removed(tmp_path, was_there):
    path = tmp_path / "theirs"
    if was_there:
        path.mkdir()
    with pytest.raises(ConfigError, match="a = 1"), RunDirectory.create(path, SETTINGS):
        raise ConfigError("a", 1, "is wrong")
    assert [*tmp_path.rglob("*")] == [path] * was_there
    with rundir.begun(path, "demo"):
        pass
    assert [*tmp_path.rglob("*")] == [path] * was_there


def finish(path, began):
    """Makes the directory of a finished run that began then, and was written now."""
    with RunDirectory.create(path, SETTINGS):
        content = json.loads((path / "config.json").read_text()) | {"began": began}
    (path / "config.json").write_text(json.dumps(content))
    (path / "summary.json").write_text("{}")
    return path


def test_a_copy_of_a_run_is_no_newer(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    old = finish(Path("runs/old"), "2026-11-23T19:00:25+00:00")
    new = finish(Path("runs/new"), "2026-11-24T01:00:25+05:00")  # an hour later
    assert rundir.newest(Path("latest")) == new
    shutil.copytree(old, "runs/older")
    shutil.copytree(new, "runs/newer")
    assert rundir.newest(Path("latest")) == new
    (new / "summary.json").unlink()
    assert rundir.newest(Path("latest")) == Path("runs/newer")


def test_a_run_that_cannot_be_written_is_not_resumed(tmp_path, monkeypatch):
    with RunDirectory.create(tmp_path / "run", SETTINGS) as run:
        run.append_metrics(stage="jmvae", step=1)

    def refuse(*_, **__):
        raise OSError(errno.EACCES, "Permission denied")  # as for a directory of mode 0555

    monkeypatch.setattr(Path, "touch", refuse)
    with pytest.raises(files.WriteError, match="Permission denied"), RunDirectory.resume(run.path):
        pytest.fail("it was resumed")


def test_a_run_records_the_commit_of_its_source(tmp_path):
    def git(folder, *command):
        who = ["-c", "user.name=A", "-c", "user.email=a@b.c"]
        command = ["git", "-C", str(folder), *who, *command]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

    assert version.commit(tmp_path) is None
    git(tmp_path, "init")
    (tmp_path / "file").write_text("1")
    git(tmp_path, "add", "file")
    git(tmp_path, "commit", "-m", "of somebody else")
    installed = tmp_path / "jaxsense" / "run" / "version.py"
    installed.parent.mkdir(parents=True)
    installed.write_text("")
    assert version.commit(tmp_path) is None
    git(tmp_path, "add", "jaxsense")
    git(tmp_path, "commit", "-m", "ours")
    git(tmp_path, "tag", "v1")
    head = git(tmp_path, "rev-parse", "HEAD")
    assert version.commit(tmp_path) == head
    (tmp_path / "file").write_text("2")
    assert version.commit(tmp_path) == f"{head}-dirty"
    root = Path(__file__).parents[2]
    with RunDirectory.create(tmp_path / "run", SETTINGS) as run:
        content = json.loads((run.path / "config.json").read_text("utf-8"))
    # Tests may run away from the source tree, and that without Git.
    is_here = Path(version.__file__).parents[2] == root and (root / ".git").exists()
    expected = git(root, "rev-parse", "HEAD") if is_here else ""
    assert (content["commit"] or "").removesuffix("-dirty") == expected
