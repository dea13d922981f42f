"""Programs that compile in the background, and those that are kept."""

import hashlib
import os
import pickle
import stat
import subprocess
import sys
import time
from concurrent.futures import CancelledError, ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsense.compilation import Compiler, Kept, Program
from jaxsense.monitor import Monitor


def test_compiling_and_running_are_timed_apart_and_reported():
    heard = []
    monitor = Monitor(lambda *report: heard.append(report))
    program = Program(Compiler(monitor), "stage", "run")
    shape = program.compile(lambda x: 2 * x, jnp.float32(3))
    assert (shape.shape, shape.dtype) == ((), jnp.float32)
    assert program(jnp.float32(3)) == 6
    assert set(monitor.seconds["stage"]) == {"compile_s", "run_s"}
    assert all(seconds > 0 for seconds in monitor.seconds["stage"].values())
    monitor.report("stage", 2, 4, np.array([1.0, 3.0]), epsilon=0.5)
    heard = [report for report in heard if report[2]]  # it may have been compiled in time
    assert heard == [("stage", 2, 4, {"loss": 2.0, "epsilon": 0.5})]


def test_a_program_may_be_called_before_it_is_compiled():
    heard = []
    program = Program(Compiler(Monitor(lambda *report: heard.append(report))), "stage", "run")
    with ThreadPoolExecutor(1) as executor:
        result = executor.submit(program, jnp.float32(3))
        while not heard:
            time.sleep(0.01)
        program.compile(lambda x: 2 * x, jnp.float32(0))
        assert result.result() == 6
    assert heard == [("stage", 0, 0, {})]


def test_whoever_waits_for_a_program_hears_why_it_cannot_come():
    waiting, broken = (Program(Compiler(Monitor()), "stage", "run") for _ in range(2))
    waiting.fail(RuntimeError("no way"))
    with pytest.raises(RuntimeError, match="no way"):
        waiting()
    broken.compile(lambda x: x, jnp.float32(0))
    assert broken(jnp.float32(1)) == 1
    broken.fail(RuntimeError("too late"))
    assert broken(jnp.float32(1)) == 1


def test_nothing_is_traced_any_more_when_a_run_is_over():
    with Compiler(Monitor()) as compiler:
        program = Program(compiler, "stage", "run")
    with pytest.raises(CancelledError):
        program.compile(lambda x: pytest.fail("was traced"), jnp.float32(0))


def call(kept, function, *args):
    """What a program gives that is called by the same name every time."""
    with Compiler(Monitor(), kept) as compiler:
        program = Program(compiler, "stage", "run")
        program.compile(function, *args)
        result = program(*args)
    while kept is not None and not list(kept.path.glob("*.pickle")):
        time.sleep(0.01)
    return result


def never(*_):
    raise AssertionError("traced")


def test_a_program_that_was_kept_is_not_traced_again(tmp_path):
    key, pair = jax.random.key(0), {"a": jnp.arange(3.0), "b": jnp.float32(2)}

    def function(key, pair):
        return jax.random.normal(key, 3) + pair["a"] * pair["b"], key

    first, first_key = call(Kept(tmp_path, "settings"), function, key, pair)
    again, again_key = call(Kept(tmp_path, "settings"), never, key, pair)
    np.testing.assert_array_equal(first, again)
    assert first_key == again_key
    other = jax.tree.map(lambda x: x + 1, pair)
    values, _ = call(Kept(tmp_path, "settings"), never, key, other)
    np.testing.assert_array_equal(values, function(key, other)[0])


def test_other_settings_shapes_and_names_are_other_programs(tmp_path):
    kept = Kept(tmp_path, "settings", 1)
    assert call(kept, lambda x: x + 1, jnp.float32(1)) == 2
    assert call(Kept(tmp_path, "settings", 2), lambda x: x + 2, jnp.float32(1)) == 3
    for args in (jnp.ones(1),), (jnp.int32(1),), (jnp.float32(1), jnp.float32(1)):
        assert kept.find("stage-run-1", args) is None
    assert kept.find("stage-other-1", (jnp.float32(1),)) is None
    assert kept.find("stage-run-1", (jnp.float32(1),)) is not None


@pytest.mark.parametrize("damage", [b"", b"no program", None])
def test_a_damaged_file_is_compiled_anew(tmp_path, damage):
    kept = Kept(tmp_path)
    assert call(kept, lambda x: 2 * x, jnp.float32(3)) == 6
    (file,) = kept.path.glob("*.pickle")
    file.write_bytes(file.read_bytes()[:-100] if damage is None else damage)
    assert call(kept, lambda x: 2 * x, jnp.float32(3)) == 6
    while kept.find("stage-run-1", (jnp.float32(3),)) is None:
        time.sleep(0.01)
    assert call(kept, never, jnp.float32(3)) == 6


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="has no modes of files")
def test_a_file_that_others_may_have_written_is_compiled_anew(tmp_path):
    kept, mask = Kept(tmp_path), os.umask(0)  # as if others might write every file
    try:
        call(kept, lambda x: 2 * x, jnp.float32(3))
    finally:
        os.umask(mask)
    (file,) = kept.path.glob("*.pickle")
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    for mode, is_found in ((0o644, True), (0o664, False), (0o646, False)):
        file.chmod(mode)
        assert (kept.find("stage-run-1", (jnp.float32(3),)) is not None) == is_found


def test_a_single_wrong_bit_is_compiled_anew(tmp_path):
    kept = Kept(tmp_path)
    call(kept, lambda x: 2 * x, jnp.float32(3))
    (file,) = kept.path.glob("*.pickle")
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content)
    assert call(kept, lambda x: 2 * x, jnp.float32(3)) == 6


def test_what_jax_cannot_load_is_compiled_anew(tmp_path):
    kept = Kept(tmp_path)
    call(kept, lambda x: 2 * x, jnp.float32(3))
    (file,) = kept.path.glob("*.pickle")
    results, number, (payload, *trees) = pickle.loads(file.read_bytes()[32:])
    content = pickle.dumps((results, number, (payload[:100], *trees)))
    file.write_bytes(hashlib.sha256(content).digest() + content)
    assert kept.find("stage-run-1", (jnp.float32(3),)) is not None
    assert call(kept, lambda x: 2 * x, jnp.float32(3)) == 6


def test_options_of_jax_are_other_settings(tmp_path):
    before = Kept(tmp_path).path
    jax.config.update("jax_threefry_partitionable", False)
    try:
        assert Kept(tmp_path).path != before
    finally:
        jax.config.update("jax_threefry_partitionable", True)
    assert Kept(tmp_path).path == before


def test_a_kept_program_finds_the_functions_that_it_calls(tmp_path):
    # Only a new process has not bound them yet.
    code = """if True:
        import sys, jax, jax.numpy as jnp
        from jaxsense.compilation import Compiler, Kept, Program
        from jaxsense.monitor import Monitor
        from pathlib import Path
        kept = Kept(Path(sys.argv[1]))
        print("kept" if list(kept.path.iterdir()) else "new")
        with Compiler(Monitor(), kept) as compiler:
            program = Program(compiler, "stage", "run")
            shape = jax.ShapeDtypeStruct((2, 2), jnp.float32)
            program.compile(jnp.linalg.cholesky, shape)
            print(program(jnp.array([[4.0, 2.0], [2.0, 5.0]])).tolist())
    """
    outputs = [
        subprocess.run(
            [sys.executable, "-c", code, str(tmp_path)],
            check=True, capture_output=True, text=True, env={**os.environ, "JAX_PLATFORMS": "cpu"},
        ).stdout
        for _ in range(2)
    ]  # fmt: skip
    # [[2, 0], [1, 2]] times its transpose is the matrix above.
    assert outputs == ["new\n[[2.0, 0.0], [1.0, 2.0]]\n", "kept\n[[2.0, 0.0], [1.0, 2.0]]\n"]


def test_programs_of_the_oldest_settings_are_forgotten(tmp_path):
    first = Kept(tmp_path, 0)
    call(first, lambda x: 2 * x, jnp.float32(3))
    os.utime(first.path, (1, 1))
    second = Kept(tmp_path, 1)
    for settings in range(2, 9):
        Kept(tmp_path, settings)
    assert not first.path.exists()
    assert second.path.exists()
    assert len(list(second.path.parent.iterdir())) == 8


def test_nothing_of_the_user_is_ever_removed(tmp_path):
    theirs = ["programs/mine/a.py", "executables/mine/a.py", f"executables/{32 * 'a'}/a.py"]
    for name in theirs:
        (tmp_path / name).parent.mkdir(parents=True)
        (tmp_path / name).write_text("precious", encoding="utf-8")
        os.utime((tmp_path / name).parent, (1, 1))
    (tmp_path / "executables").chmod(0o700)
    (tmp_path / "executables" / (32 * "b")).symlink_to(tmp_path / "programs" / "mine")
    (tmp_path / "executables" / (32 * "c")).write_text("precious", encoding="utf-8")
    program = tmp_path / "programs" / "mine" / f"stage-{16 * '0'}.pickle"
    program.write_text("precious", encoding="utf-8")
    theirs += [str(program), f"executables/{32 * 'c'}"]
    for settings in range(10):
        Kept(tmp_path, settings)
    assert all((tmp_path / name).read_text(encoding="utf-8") == "precious" for name in theirs)


def test_programs_lie_in_a_directory_of_the_user_alone(tmp_path, monkeypatch):
    kept = Kept(tmp_path)
    for path in (kept.path, kept.path.parent):
        assert stat.S_IMODE(path.stat().st_mode) == 0o700
    kept.path.parent.chmod(0o770)
    with pytest.raises(PermissionError, match="must be a directory of yours alone, with mode 0700"):
        Kept(tmp_path)
    kept.path.parent.chmod(0o700)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "getuid", lambda: os.geteuid() + 1)
        with pytest.raises(PermissionError, match="must be a directory of yours alone"):
            Kept(tmp_path)
    (tmp_path / "link").mkdir()
    (tmp_path / "link" / "executables").symlink_to(kept.path.parent)
    with pytest.raises(PermissionError, match="must be a directory of yours alone"):
        Kept(tmp_path / "link")


def test_without_room_nothing_is_kept_and_nothing_fails(tmp_path):
    kept = Kept(tmp_path)
    kept.path.rmdir()
    kept.path.write_text("in the way")
    with Compiler(Monitor(), kept) as compiler:
        program = Program(compiler, "stage", "run")
        program.compile(lambda x: 2 * x, jnp.float32(3))
        assert program(jnp.float32(3)) == 6
    assert kept.path.read_text() == "in the way"


def test_nothing_is_kept_beside_a_cache_of_jax(tmp_path):
    compiled = jax.jit(lambda x: 2 * x).lower(1.0).compile()
    kept = Kept(tmp_path)
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "jax"))
    try:
        kept.save("stage-run", (1.0,), None, compiled)
    finally:
        jax.config.update("jax_compilation_cache_dir", None)
    assert not list(kept.path.iterdir())
    kept.save("stage-run", (1.0,), None, compiled)
    assert list(kept.path.iterdir())
