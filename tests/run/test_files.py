"""Files that are written as a whole, directories that are kept, and checkpoints."""

import os
import queue
import stat
import threading
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsense.config import ConfigError
from jaxsense.core.supervised import FitState
from jaxsense.run import files
from jaxsense.run.files import UNFINISHED, Checkpoints

TREE = {"a": np.arange(6, dtype=np.float32).reshape(2, 3), "b": (np.int32(4), np.array([True]))}
SHAPES = jax.eval_shape(lambda: jax.tree.map(jnp.asarray, TREE))


@pytest.fixture
def synced(monkeypatch):
    """Whether each thing that reaches the disk is a directory, in order."""
    found, sync = [], os.fsync
    is_directory = lambda n: stat.S_ISDIR(os.fstat(n).st_mode)  # noqa: E731
    monkeypatch.setattr(os, "fsync", lambda n: (found.append(is_directory(n)), sync(n)))
    return found


def test_a_file_is_replaced_as_a_whole_and_made_durable(tmp_path, synced):
    path = tmp_path / "file"
    files.write(path, "first")
    files.write(path, b"second")
    assert path.read_bytes() == b"second"
    assert synced == [False, True] * 2
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    ("error", "reason"),
    [(OSError(28, "full"), "No space left on device"), (OSError("too far"), "too far")],
)
def test_a_file_that_cannot_be_written_stays_as_it_was(tmp_path, monkeypatch, error, reason):
    path = tmp_path / "file"
    files.write(path, "first")

    def fail(number):
        raise error

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(files.WriteError) as raised:
        files.write(path, "second")
    assert (raised.value.strerror, raised.value.filename) == (reason, str(path))
    assert path.read_text(encoding="utf-8") == "first"
    assert list(tmp_path.iterdir()) == [path]


def test_many_writers_of_one_file_never_mix(tmp_path):
    path, texts = tmp_path / "file", [letter * 100_000 for letter in "abcdefgh"]
    with ThreadPoolExecutor(8) as executor:
        list(executor.map(lambda text: files.write(path, text), texts * 5))
    assert path.read_text(encoding="utf-8") in texts
    assert list(tmp_path.iterdir()) == [path]


def test_only_what_a_write_has_left_is_removed(tmp_path):
    left = ".summary.json.0123456789abcdef.unfinished"
    kept = [".thesis.unfinished", "a.0123456789abcdef.unfinished", ".a.0123.unfinished"]
    (tmp_path / "seed-1").mkdir()
    kept.append(f"seed-1/{left}")  # of a process that may be writing it
    for name in (left, *kept):
        (tmp_path / name).write_text("precious")
    folder = tmp_path / ".b.0123456789abcdef.unfinished"
    folder.mkdir()
    files.remove_unfinished(tmp_path)
    assert not (tmp_path / left).exists()
    assert folder.exists()
    assert all((tmp_path / name).exists() for name in kept)


def test_a_directory_is_kept_for_one_at_a_time(tmp_path, monkeypatch):
    monkeypatch.setattr(files, "_WAIT_BEFORE_NOTICE", 0.1)
    order, said = [], queue.Queue()

    def wait():
        with files.locked(tmp_path, on_wait=said.put):
            order.append("second")

    with files.locked(tmp_path, on_wait=pytest.fail):
        with pytest.raises(BlockingIOError), files.locked(tmp_path):
            pass
        waiting = threading.Thread(target=wait)
        waiting.start()
        line = said.get(timeout=10)
        assert line == f"Waiting for another process to finish writing to {tmp_path}."
        order.append("first")
    waiting.join()
    assert order == ["first", "second"]
    assert said.empty()


def test_a_checkpoint_comes_back_as_it_was_saved(tmp_path):
    checkpoints = Checkpoints(tmp_path / "checkpoints")
    assert checkpoints.load_or_forget("tree", SHAPES) is None
    with pytest.raises(ConfigError, match=r"tree.msgpack': is missing"):
        checkpoints.load("tree", SHAPES)
    checkpoints.save("tree", TREE)
    found = checkpoints.load("tree", SHAPES)
    assert jax.tree.structure(found) == jax.tree.structure(TREE)
    for here, there in zip(jax.tree.leaves(found), jax.tree.leaves(TREE), strict=True):
        assert here.dtype == there.dtype
        np.testing.assert_array_equal(here, there)


DAMAGES = {
    "flipped bit": lambda content, i: content[:i] + bytes([content[i] ^ 4]) + content[i + 1 :],
    "truncated": lambda content, i: content[:i],
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_every_damage_is_noticed_and_named_and_put_aside(tmp_path, damage, capsys):
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save("tree", TREE)
    file = tmp_path / "tree.msgpack"
    content = file.read_bytes()
    for i in range(len(content)):
        damaged = DAMAGES[damage](content, i)
        file.write_bytes(damaged)
        with pytest.raises(ConfigError, match=r"tree.msgpack': is damaged"):
            checkpoints.load("tree", SHAPES)
    assert checkpoints.load_or_forget("tree", SHAPES) is None
    (line,) = capsys.readouterr().err.splitlines()
    assert "tree.msgpack': is damaged" in line
    assert line.endswith("retraining it")
    assert (tmp_path / "tree.msgpack.damaged").read_bytes() == damaged
    checkpoints.save("tree", TREE)
    assert checkpoints.load_or_forget("tree", SHAPES) is not None
    assert not capsys.readouterr().err


@pytest.mark.parametrize(
    ("shapes", "expected"),
    [
        ({**SHAPES, "a": jax.ShapeDtypeStruct((3, 2), np.float32)}, r"float32\(2, 3\) in place of"),
        ({**SHAPES, "a": jax.ShapeDtypeStruct((2, 3), np.int32)}, r"place of int32\(2, 3\)"),
        ({"a": SHAPES["a"]}, "of other settings"),
    ],
)
def test_a_checkpoint_of_other_shapes_is_named(tmp_path, shapes, expected):
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save("tree", TREE)
    with pytest.raises(ConfigError, match=expected):
        checkpoints.load("tree", shapes)


def test_a_training_under_way_comes_back_and_is_forgotten_when_it_is_over(tmp_path, capsys):
    checkpoints, name = Checkpoints(tmp_path), f"{UNFINISHED}/jmvae"
    state = [FitState({"w": np.ones(2, np.float32)}, (np.int32(3),), np.int32(7), np.float32(0.5))]
    checkpoints.save(name, state)
    checkpoints.save("tree", TREE)
    (found,) = checkpoints.load(name, state)
    assert isinstance(found, FitState)
    np.testing.assert_array_equal(found.params["w"], [1, 1])
    theirs = tmp_path / "unfinished" / "theirs.msgpack"
    theirs.write_text("precious")
    checkpoints.forget_unfinished(["jmvae"])
    assert [*(tmp_path / "unfinished").iterdir()] == [theirs]
    theirs.unlink()
    checkpoints.forget_unfinished(["jmvae"])
    assert not (tmp_path / "unfinished").exists()
    assert checkpoints.load_or_forget(name, state) is None
    assert checkpoints.load("tree", SHAPES) is not None
    assert not capsys.readouterr().err
