"""Programs that are kept in a directory for later runs."""

import dataclasses
import os
import shutil
import stat
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from flax import struct

import jaxsense
from jaxsense.config import PRESETS, SensorConfig
from jaxsense.core.types import Belief, pytree
from jaxsense.run import cli, files, version
from jaxsense.run import kept as kept_programs
from jaxsense.run.compilation import Compiler, Program
from jaxsense.run.kept import Kept
from jaxsense.run.monitor import Monitor


def call(kept, function, *args):
    """What a program gives that is called by the same name every time."""
    with Compiler(Monitor(), kept) as compiler:
        program = Program(compiler, "stage", "run")
        program.compile(function, *args)
        return program(*args)


TOLD = "jaxsense: {}: a program must be traced again ("


def never(*_):
    raise AssertionError("traced")


def test_a_program_that_was_kept_is_not_traced_again(tmp_path):
    key, pair = jax.random.key(0), {"a": jnp.arange(3.0), "b": 2.0}

    def function(key, pair):
        return Belief(jax.random.normal(key, 3) + pair["a"] * pair["b"], pair["a"]), key

    first, first_key = call(Kept(tmp_path, "settings"), function, key, pair)
    again, again_key = call(Kept(tmp_path, "settings"), never, key, pair)
    assert isinstance(again, Belief)
    np.testing.assert_array_equal(first.mean, again.mean)
    assert first_key == again_key
    other = jax.tree.map(lambda x: x + 1, pair)
    values, _ = call(Kept(tmp_path, "settings"), never, key, other)
    np.testing.assert_array_equal(values.mean, function(key, other)[0].mean)


@pytree
class Labelled:
    """A value with a static field that JSON has no word for."""

    value: jax.Array
    labels: frozenset[str] = struct.field(pytree_node=False)


STATES = {
    "static field": Labelled(jnp.ones(2), frozenset({"red"})),
    "optax": optax.chain(optax.clip(1.0), optax.adam(optax.linear_schedule(1.0, 0.0, 9))).init(
        {"w": jnp.ones(2)}
    ),
    "dictionary": {"b": jnp.ones(1), "a": [None, (jnp.int32(3), jax.random.key(0))]},
}


@pytest.mark.parametrize("state", STATES.values(), ids=STATES)
def test_all_pytrees_are_kept(tmp_path, state):
    call(Kept(tmp_path), lambda x: (x, jnp.zeros(1)), state)
    again, zero = call(Kept(tmp_path), never, state)
    assert jax.tree.structure(again) == jax.tree.structure(state)
    assert all(jax.tree.leaves(jax.tree.map(lambda x, y: (x == y).all(), again, state)))
    assert zero == 0


REGISTERED = """
import importlib, optax
from jax import export
export.register_namedtuple_serialization(optax.ScaleByAdamState, serialized_name="theirs")
import jaxsense.train, jaxsense.core.types
importlib.reload(jaxsense.core.types)
"""


@pytest.mark.slow
def test_nothing_is_registered_with_jax_so_modules_can_be_reloaded():
    command = [sys.executable, "-c", REGISTERED]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr


def test_other_settings_shapes_and_names_are_other_programs(tmp_path):
    kept = Kept(tmp_path, "settings", 1)
    assert call(kept, lambda x: x + 1, jnp.float32(1)) == 2
    assert call(Kept(tmp_path, "settings", 2), lambda x: x + 2, jnp.float32(1)) == 3
    for args in (jnp.ones(1),), (jnp.int32(1),), (jnp.float32(1), jnp.float32(1)):
        assert kept.find("stage-run", args) is None
    assert kept.find("stage-other", (jnp.float32(1),)) is None
    assert kept.find("stage-run", (jnp.float32(1),)) is not None


def test_the_numbers_of_settings_are_no_other_program(tmp_path):
    config = PRESETS["smoke"]
    settings = dataclasses.replace(config.jmvae, alpha=3.0)

    def alpha(config):
        return 2 * config.jmvae.alpha

    assert call(Kept(tmp_path), alpha, config) == pytest.approx(2 * config.jmvae.alpha)
    assert call(Kept(tmp_path), never, dataclasses.replace(config, jmvae=settings)) == 6
    sizes = dataclasses.replace(config.jmvae, latent_size=3)
    with pytest.raises(AssertionError, match="traced"):
        call(Kept(tmp_path), never, dataclasses.replace(config, jmvae=sizes))


@pytest.mark.parametrize("damage", [b"", b"no program", None])
def test_a_damaged_file_is_traced_anew(tmp_path, damage, capsys):
    kept = Kept(tmp_path)
    assert call(kept, lambda x: 2 * x, jnp.float32(3)) == 6
    (file,) = kept.path.glob("*.stablehlo")
    assert capsys.readouterr().err == ""
    for told in (f"{TOLD.format(kept.path)}ValueError wrong digest)\n", ""):  # once
        file.write_bytes(file.read_bytes()[:-100] if damage is None else damage)
        assert call(kept, lambda x: 2 * x, jnp.float32(3)) == 6
        assert capsys.readouterr().err == told
    assert call(kept, never, jnp.float32(3)) == 6


def test_a_fault_of_the_cache_shows_and_ends_nothing(tmp_path, capsys, monkeypatch):
    kept = Kept(tmp_path)
    call(kept, lambda x: 2 * x, jnp.float32(3))
    monkeypatch.setattr(kept_programs.export, "deserialize", never)
    assert call(kept, lambda x: 2 * x, jnp.float32(3)) == 6
    assert capsys.readouterr().err == f"{TOLD.format(kept.path)}AssertionError traced)\n"


def test_the_error_of_a_program_is_its_own(tmp_path):
    def fails(x):
        raise ValueError("mine")

    with pytest.raises(ValueError, match="mine"):
        call(Kept(tmp_path), fails, jnp.float32(3))


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="has no modes of files")
def test_a_file_that_others_may_have_written_is_compiled_anew(tmp_path):
    kept, mask = Kept(tmp_path), os.umask(0)  # as if others might write every file
    try:
        call(kept, lambda x: 2 * x, jnp.float32(3))
    finally:
        os.umask(mask)
    (file,) = kept.path.glob("*.stablehlo")
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    for mode, is_found in ((0o644, True), (0o664, False), (0o646, False)):
        file.chmod(mode)
        assert (kept.find("stage-run", (jnp.float32(3),)) is not None) == is_found


def test_a_single_wrong_bit_is_compiled_anew(tmp_path):
    kept = Kept(tmp_path)
    call(kept, lambda x: 2 * x, jnp.float32(3))
    (file,) = kept.path.glob("*.stablehlo")
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content)
    assert call(kept, lambda x: 2 * x, jnp.float32(3)) == 6


def test_what_jax_cannot_write_is_traced_every_time(tmp_path, capsys):
    kept = Kept(tmp_path)

    def function(x):
        return jax.pure_callback(lambda x: 2 * x, x, x)

    for _ in range(2):
        assert call(kept, function, jnp.float32(3)) == 6
    assert not list(kept.path.glob("*.stablehlo"))
    told = capsys.readouterr().err
    assert told.startswith(f"{TOLD.format(kept.path)}NotImplementedError")
    assert told.count("\n") == 1


def test_a_full_disk_ends_nothing(tmp_path, monkeypatch, capsys):
    def full(*args, **options):
        raise files.WriteError(28, "No space left on device")

    monkeypatch.setattr(files, "write_digested", full)
    assert call(Kept(tmp_path), lambda x: 2 * x, jnp.float32(3)) == 6
    assert "(WriteError No space left on device)\n" in capsys.readouterr().err


def test_options_of_jax_are_other_settings(tmp_path):
    def is_there():
        return Kept(tmp_path).find("stage-run", (jnp.float32(3),)) is not None

    call(Kept(tmp_path), lambda x: 2 * x, jnp.float32(3))
    jax.config.update("jax_threefry_partitionable", False)
    try:
        assert not is_there()
    finally:
        jax.config.update("jax_threefry_partitionable", True)
    assert is_there()
    # A run that sets where JAX keeps what it compiles finds what it has kept before.
    before = jax.config.values["jax_compilation_cache_dir"]
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "elsewhere"))
    try:
        assert is_there()
    finally:
        jax.config.update("jax_compilation_cache_dir", before)


@pytest.fixture(scope="module")
def two_processes(tmp_path_factory):
    """What two processes print that use one directory, and how many compiled programs they keep.

    The second has been told to keep these elsewhere.
    """
    path = tmp_path_factory.mktemp("kept")
    code = """if True:
        import sys, jax, jax.numpy as jnp
        from jaxsense.run.compilation import Compiler, Program
        from jaxsense.run.kept import Kept, use_cache
        from jaxsense.run.monitor import Monitor
        from pathlib import Path
        use_cache(Path(sys.argv[1]))
        kept = Kept(Path(sys.argv[1]))
        print("kept" if list(kept.path.iterdir()) else "new")
        with Compiler(Monitor(), kept) as compiler:
            program = Program(compiler, "stage", "run")
            shape = jax.ShapeDtypeStruct((2, 2), jnp.float32)
            program.compile(jnp.linalg.cholesky, shape)
            print(program(jnp.array([[4.0, 2.0], [2.0, 5.0]])).tolist())
        jax.jit(lambda x: int(sys.argv[2]) * x)(jnp.arange(3))  # new to each of them
    """
    environment = {**os.environ, "JAX_PLATFORMS": "cpu"}
    said, compiled = [], []
    for elsewhere in (None, path / "theirs"):
        environment.pop("JAX_COMPILATION_CACHE_DIR", None)
        if elsewhere is not None:
            environment["JAX_COMPILATION_CACHE_DIR"] = str(elsewhere)
        own = path / "own"
        before = set(own.glob("compiled/*-cache"))
        command = [sys.executable, "-c", code, str(own), str(2 + len(said))]
        ended = subprocess.run(command, check=True, capture_output=True, text=True, env=environment)
        said.append(ended.stdout)
        compiled.append(len(set(own.glob("compiled/*-cache")) - before))
    return said, compiled


def test_a_kept_program_finds_the_functions_that_it_calls(two_processes):
    # Only a new process has not bound them yet. [[2, 0], [1, 2]] times its transpose is the matrix.
    expected = "[[2.0, 0.0], [1.0, 2.0]]\n"
    assert two_processes[0] == ["new\n" + expected, "kept\n" + expected]


def test_the_oldest_programs_are_forgotten(tmp_path, monkeypatch):
    kept = Kept(tmp_path)
    for size in range(4):
        call(kept, lambda x: 2 * x, jnp.ones(size))
    paths = [kept._file("stage-run", (jnp.ones(size),)) for size in range(4)]
    for age, path in enumerate(paths):
        os.utime(path, (age, age))
    assert kept.find("stage-run", (jnp.ones(0),)) is not None  # used just now
    monkeypatch.setattr(kept_programs, "_MAX_KEPT", 2)
    Kept(tmp_path)
    assert [path.exists() for path in paths] == [True, False, False, True]


def test_nothing_of_the_user_is_ever_removed(tmp_path, monkeypatch):
    monkeypatch.setattr(kept_programs, "_MAX_KEPT", 0)
    kept = Kept(tmp_path)
    name = f"stage-run-{32 * '0'}.stablehlo"
    theirs = [tmp_path / "mine" / name, kept.path / "mine" / name, kept.path / f"{name}.txt"]
    for path in theirs:
        path.parent.mkdir(exist_ok=True)
        path.write_text("precious", encoding="utf-8")
    (kept.path / f"stage-run-{32 * '1'}.stablehlo").symlink_to(theirs[0])
    (kept.path / f"stage-run-{32 * '2'}.stablehlo").mkdir()
    Kept(tmp_path)
    assert all(path.read_text(encoding="utf-8") == "precious" for path in theirs)
    assert len(list(kept.path.iterdir())) == 4


def test_programs_of_all_stages_are_forgotten(tmp_path, monkeypatch):
    kept, x = Kept(tmp_path), jnp.ones(1)
    names = "mission-go_on", "detector_Wärme-begin", "policies_lidar-begin", "jmvae-advance"
    for name in names:
        assert kept.find_or_trace(name, lambda x: x, (x,)) is not None
    assert len(list(kept.path.iterdir())) == 4
    monkeypatch.setattr(kept_programs, "_MAX_KEPT", 1)
    Kept(tmp_path)
    assert len(list(kept.path.iterdir())) == 1


def test_another_source_is_another_program(tmp_path, monkeypatch):
    def is_there():
        return Kept(tmp_path).find("stage-run", (jnp.float32(3),)) is not None

    call(Kept(tmp_path), lambda x: 2 * x, jnp.float32(3))
    assert is_there()
    monkeypatch.setattr(version, "SOURCE", version.SOURCE[::-1])
    assert not is_there()


def test_the_source_is_that_of_the_whole_package(tmp_path):
    root = Path(jaxsense.__file__).parent
    shutil.copytree(root, tmp_path / "jaxsense", ignore=shutil.ignore_patterns("*.pyc"))
    code = "from jaxsense.run import version; print(version.__file__, version.SOURCE)"

    def told():
        environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
        command = [sys.executable, "-c", code]
        found = subprocess.check_output(command, env=environment, cwd=tmp_path, text=True)
        file, source = found.split()
        assert file == str(tmp_path / "jaxsense" / "run" / "version.py")
        return source

    assert told() == version.SOURCE
    with (tmp_path / "jaxsense" / "vae" / "gaussian.py").open("a", encoding="utf-8") as file:
        file.write("\n")
    assert told() != version.SOURCE


def test_programs_of_custom_sensors_are_not_kept(tmp_path):
    """Their code may change while their settings stay."""
    config = PRESETS["smoke"]
    sensors = {"thermal": SensorConfig("thermal:make", "colour")}
    own = dataclasses.replace(config, sensors=sensors, modalities=("lidar", "thermal"))
    assert cli.keep_programs("train", tmp_path, own) is None
    assert [path.name for path in tmp_path.iterdir()] == ["compiled"]
    kept = cli.keep_programs("train", tmp_path, config)
    assert kept is not None
    assert kept.path == tmp_path / "traced"


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="has no users")
def test_what_another_user_owns_is_not_run(tmp_path, monkeypatch):
    kept, x = Kept(tmp_path), jnp.float32(3)
    call(kept, lambda x: 2 * x, x)
    assert kept.find("stage-run", (x,)) is not None
    own = os.getuid()
    monkeypatch.setattr(os, "getuid", lambda: own + 1)
    assert kept.find("stage-run", (x,)) is None
    with pytest.raises(PermissionError, match="traced must be a directory that you own"):
        Kept(tmp_path)


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="has no modes of files")
def test_a_directory_that_others_may_write_is_refused(tmp_path):
    for name, begin in (("compiled", kept_programs.use_cache), ("traced", Kept)):
        begin(tmp_path)
        (tmp_path / name).chmod(0o770)
        with pytest.raises(PermissionError, match=f"{name} must be a directory that you own"):
            begin(tmp_path)
        (tmp_path / name).chmod(0o700)


def test_jax_keeps_what_it_compiles_beside_it_unless_it_was_told_where(two_processes):
    _, (first, second) = two_processes
    assert first > 0
    assert second == 0
