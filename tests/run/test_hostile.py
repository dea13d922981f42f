"""Run directories that somebody has prepared: nothing hangs, nothing outside is touched."""

import contextlib
import functools
import hashlib
import io
import json
import os
import shutil
import sys

import numpy as np
import pytest
from flax import serialization
from smoke import contents, save_models
from summaries import CASE, EVALUATION, RESULTS, SUMMARY
from untrained import blank

import jaxsense
from jaxsense import evaluate
from jaxsense.config import PRESETS, ConfigError
from jaxsense.core.types import by_place
from jaxsense.run.rundir import RunDirectory
from jaxsense.run.settings import Settings
from jaxsense.summary import compare
from jaxsense.summary.read import read_summary

FEWER = SUMMARY["jmvae"] | {"unambiguous": {"joint": [True]}}
BLOCKS = {name: SUMMARY[name] for name in RESULTS}
OF_SEEDS = {**compare.statistics([BLOCKS, BLOCKS]), "seeds": {"3": BLOCKS, "4": BLOCKS}}
DEEP = '{"a": ' * 100_000 + "1" + "}" * 100_000
pytestmark = [
    pytest.mark.skipif(sys.platform == "win32", reason="has no FIFO, and no links for everybody"),
    pytest.mark.timeout(120),
]

CONFIG = PRESETS["smoke"]
STATE = {"w": np.ones(3, np.float32)}
SPARSE = 2**30  # bytes
CURVES = {"loss": np.ones(10, np.float32), "seconds": np.ones(4, np.float32)}
TRAINING = {"state": STATE, "curves": CURVES}


@pytest.fixture(scope="module")
def base(tmp_path_factory):
    """A finished run that nobody has trained, with all its files, stopped in a training."""
    path = tmp_path_factory.mktemp("base") / "run"
    with RunDirectory.create(path, Settings("smoke", 0, CONFIG)) as run:
        save_models(run, blank(CONFIG))
        run.checkpoints.save("unfinished/dqn_camera", TRAINING)
        run.append_metrics(stage="jmvae", step=1, loss=0.5)
    (path / "summary.json").write_text(json.dumps(SUMMARY))
    (path / "evaluations").mkdir()
    (path / "evaluations" / "there.json").write_text(json.dumps(EVALUATION))
    for name in ("reward.svg", "mission.svg", "evaluations/there.svg"):
        (path / name).write_text('<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 8 4"/>')
    return path


def outcome(function, *args):
    """What a reader says: its one line, or nothing if it found no fault."""
    try:
        function(*args)
    except (ConfigError, OSError) as error:
        return str(error)
    return ""


def resume(path):
    """What a resumed run does with its directory until it has finished."""
    file = path / "summary.json"
    shutil.rmtree(file) if file.is_dir() else file.unlink()
    with RunDirectory.resume(path) as run:
        run.checkpoints.load_or_forget("best_jmvae", blank(CONFIG).jmvae, finite=True)
        run.checkpoints.load_or_forget("unfinished/dqn_camera", TRAINING)
        run.checkpoints.save("unfinished/dqn_camera", TRAINING)
        run.append_metrics(stage="jmvae", step=2, loss=0.5)
        run.checkpoints.forget_unfinished(["dqn_camera"])


def put(name, make):
    """Something else in place of a file or directory; text or bytes are the content of a file."""

    def change(run, outside):
        path = run / name
        shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
        if isinstance(make, str | bytes):
            path.write_bytes(make.encode() if isinstance(make, str) else make)
        else:
            make(path, outside)

    return change


def fifo(path, outside):
    os.mkfifo(path)


def sparse(path, outside):
    with path.open("wb") as file:
        file.truncate(SPARSE)


def link(path, outside, target="secret"):
    path.symlink_to(outside / target)


to_folder = functools.partial(link, target="folder")


def hard_link(path, outside):
    path.hardlink_to(outside / "secret")


def directory(path, outside):
    (path / "inner").mkdir(parents=True)


def digested(name, content):
    """A checkpoint with a right digest."""
    if not isinstance(content, bytes):
        content = serialization.msgpack_serialize(content)
    return put(f"checkpoints/{name}.msgpack", hashlib.sha256(content).digest() + content)


def unfinished(**changed):
    """The training under way, of which some parts are others."""
    return digested("unfinished/dqn_camera", by_place(TRAINING | changed))


def edited(name, **changed):
    """A JSON file of which some keys have other values, or none."""

    def change(run, outside):
        content = json.loads((run / name).read_text()) | changed
        content = {key: value for key, value in content.items() if value is not None}
        (run / name).write_text(json.dumps(content))

    return change


def poisoned(run, outside):
    """NaN in a file whose digest is right."""
    content = bytearray((run / "checkpoints" / "best_jmvae.msgpack").read_bytes()[32:])
    content[-8:] = np.float32([np.nan, np.nan]).tobytes()
    digested("best_jmvae", bytes(content))(run, outside)


NAMES = (
    *("config.json", "summary.json", "metrics.jsonl", "mission.svg", "reward.svg"),
    *("evaluations/there.json", "checkpoints/best_jmvae.msgpack"),
)
SOME = "summary.json", "metrics.jsonl", "checkpoints/best_jmvae.msgpack"
FOLDERS = "checkpoints", "checkpoints/unfinished", "evaluations"
DAMAGED = "is damaged or of other settings"
NOT_NUMBERS = "numbers that are not finite"
WRONG = "must hold the summary.json of a finished run"
# What somebody has done, and what a reader must say of it; nothing where it may be overlooked.
CASES = {
    **{f"fifo {name}": (put(name, fifo), "Not a regular file") for name in SOME},
    **{f"link {name}": (put(name, link), "Leads out of its directory") for name in NAMES},
    **{f"link {name}/": (put(name, to_folder), "Leads out of its directory") for name in FOLDERS},
    **{f"sparse {name}": (put(name, sparse), "Larger than") for name in SOME},
    **{f"directory {name}": (put(name, directory), "Is a directory") for name in SOME},
    "fifo .lock": (put(".lock", fifo), ""),
    "link .lock": (put(".lock", link), "symbolic link"),
    "hard link": (put("metrics.jsonl", hard_link), ""),
    "model deep": (digested("best_jmvae", b"\x81\xa1a" * 1000 + b"\x01"), DAMAGED),
    "model of 2^32 items": (digested("best_jmvae", b"\xdd\xff\xff\xff\xff"), DAMAGED),
    "model NaN": (poisoned, NOT_NUMBERS),
    "curves none": (unfinished(curves={}), "it holds other arrays"),
    "curves long": (unfinished(curves=CURVES | {"seconds": np.ones(9, np.float32)}), DAMAGED),
    "state": (unfinished(state={"w": np.ones(4, np.float32)}), "in place of float32(3,)"),
    "no digest": (
        edited("config.json", digest=None, seed=7),
        "config.json has changed since the run began",
    ),
    "escapes": (edited("config.json", versions={"jaxsense": "\x1b[2J\n"}), r"jaxsense \x1b[2J\n; "),
    "metrics": (put("metrics.jsonl", '{"stage": "a", "step": Infinity}\n[1]\n'), ""),
    "summary deep": (put("summary.json", DEEP), "nested too deeply"),
    "summary Infinity": (edited("summary.json", later=float("inf")), WRONG),
    "summary of seeds": (edited("summary.json", **OF_SEEDS), "holds several seeds; choose one"),
    "many cases": (edited("summary.json", mission={str(i): CASE for i in range(2000)}), WRONG),
    "other classes": (edited("summary.json", jmvae=FEWER), "must each have a value for 3 classes"),
    "film": (put("mission.svg", b"\xff\xfe\x00" * 1000), ""),
}


@pytest.mark.parametrize("name", CASES)
def test_a_directory_that_somebody_has_prepared(name, base, tmp_path):
    run, outside = tmp_path / "runs" / "run", tmp_path / "outside"
    shutil.copytree(base, run)
    (outside / "folder").mkdir(parents=True)
    for secret in ("secret", "model.msgpack", "folder/model.msgpack", "folder/there.json"):
        (outside / secret).write_text("precious")
    change, expected = CASES[name]
    change(run, outside)
    before, warned = contents(outside), io.StringIO()
    said = [outcome(jaxsense.load, run), outcome(evaluate._report, run, CONFIG)]
    with contextlib.redirect_stderr(warned):
        said.append(outcome(resume, run))
    said += warned.getvalue().splitlines()
    assert any(expected in line for line in said), said
    assert expected or not any(said), said
    assert contents(outside) == before
    assert all(line.isprintable() for line in said)


def test_the_directory_itself_is_sound(base, tmp_path, capsys):
    """Nothing is said about what nobody has changed."""
    shutil.copytree(base, tmp_path / "run")
    assert jaxsense.load(tmp_path / "run")[0] == CONFIG
    assert read_summary(tmp_path / "run") == SUMMARY
    evaluate._report(tmp_path / "run", CONFIG)
    resume(tmp_path / "run")
    assert capsys.readouterr().err == ""
    lines = (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()
    assert [json.loads(line)["step"] for line in lines] == [1, 2]
    assert not (tmp_path / "run" / "checkpoints" / "unfinished").exists()
