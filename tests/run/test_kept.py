"""Programs that compile in the background, and are kept in a directory for later runs."""

import dataclasses
import os
import shutil
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
from jaxsense.run import cli, version
from jaxsense.run.compilation import Compiler, Program
from jaxsense.run.kept import _MAX_BYTES, Kept, use_cache
from jaxsense.run.monitor import Monitor

ONE = jnp.float32(1)


def call(kept, function, *args, name="run"):
    """What a program gives."""
    with Compiler(Monitor(), kept) as compiler:
        program = Program(compiler, "stage", name)
        program.compile(function, *args)
        return program(*args)


def test_compiling_and_running_are_timed_apart():
    monitor = Monitor()
    program = Program(Compiler(monitor), "stage", "run")
    shape = program.compile(lambda x: 2 * x, jnp.float32(3))
    assert (shape.shape, shape.dtype) == ((), jnp.float32)
    assert program(jnp.float32(3)) == 6
    timing = monitor.timing()
    (seconds,) = timing["stages"].values()
    assert list(timing["stages"]) == ["stage"]
    assert 0 < seconds["run_s"] < seconds["compile_s"]
    assert seconds["run_s"] + seconds["compile_s"] < timing["total_s"]


TOLD = "jaxsense: {}: a program must be traced again ("


def never(*_):
    raise AssertionError("traced")


def is_kept(path, *args, name="run", settings=()):
    """Whether a program with such arguments is found again."""
    try:
        call(Kept(path, *settings), never, *args, name=name)
    except AssertionError:
        return False
    return True


@pytree
class Labelled:
    """A value with a static field that JSON has no word for."""

    value: jax.Array
    labels: frozenset[str] = struct.field(pytree_node=False)


OPTIMISER = optax.chain(optax.clip(1.0), optax.adam(optax.linear_schedule(1.0, 0.0, 9)))


def test_a_program_that_was_kept_is_not_traced_again(tmp_path):
    state = {
        "label": Labelled(jnp.ones(2), frozenset({"red"})),
        "optax": OPTIMISER.init({"w": jnp.ones(2)}),
        "key": [None, (jnp.int32(3), jax.random.key(0))],
    }

    def function(state, number):
        drawn = jax.random.normal(state["key"][1][1], 3)
        return Belief(drawn * number, state["label"].value), state

    first = call(Kept(tmp_path), function, state, 2.0)
    again = call(Kept(tmp_path), never, state, 2.0)
    assert jax.tree.structure(again) == jax.tree.structure(first)
    assert all(jax.tree.leaves(jax.tree.map(lambda x, y: (x == y).all(), again, first)))
    belief, _ = call(Kept(tmp_path), never, state, 3.0)
    np.testing.assert_allclose(belief.mean, 1.5 * first[0].mean, rtol=1e-6)


def test_other_settings_shapes_names_and_code_are_other_programs(tmp_path, monkeypatch):
    assert call(Kept(tmp_path, "settings", 1), lambda x: x + 1, ONE) == 2
    assert is_kept(tmp_path, ONE, settings=("settings", 1))
    assert not is_kept(tmp_path, ONE, settings=("settings", 2))
    for args in (jnp.ones(1),), (jnp.int32(1),), (ONE, ONE):
        assert not is_kept(tmp_path, *args, settings=("settings", 1))
    assert not is_kept(tmp_path, ONE, name="other", settings=("settings", 1))
    with monkeypatch.context() as patch:
        patch.setattr(version, "SOURCE", version.SOURCE[::-1])
        assert not is_kept(tmp_path, ONE, settings=("settings", 1))


def test_the_numbers_of_settings_are_no_other_program(tmp_path):
    config = PRESETS["smoke"]
    settings = dataclasses.replace(config.jmvae, alpha=3.0)

    def alpha(config):
        return 2 * config.jmvae.alpha

    assert call(Kept(tmp_path), alpha, config) == pytest.approx(2 * config.jmvae.alpha)
    assert call(Kept(tmp_path), never, dataclasses.replace(config, jmvae=settings)) == 6
    sizes = dataclasses.replace(config.jmvae, latent_size=3)
    assert not is_kept(tmp_path, dataclasses.replace(config, jmvae=sizes))


@pytest.mark.parametrize("damage", ["empty", "other", "cut", "bit"])
def test_a_damaged_file_is_traced_anew(tmp_path, damage, capsys):
    kept = Kept(tmp_path)
    assert call(kept, lambda x: 2 * x, ONE) == 2
    (file,) = kept.path.glob("*.stablehlo")
    assert capsys.readouterr().err == ""
    flipped = bytearray(file.read_bytes())
    flipped[len(flipped) // 2] ^= 1
    content = {"empty": b"", "other": b"no program", "cut": flipped[:-100], "bit": flipped}[damage]
    for told in (f"{TOLD.format(kept.path)}ValueError wrong digest)\n", ""):  # once
        file.write_bytes(content)
        assert call(kept, lambda x: 2 * x, ONE) == 2
        assert capsys.readouterr().err == told
    assert call(kept, never, ONE) == 2


FACTORS = """
import sys
from pathlib import Path
import jax, jax.numpy as jnp
from jaxsense.run.compilation import Compiler, Program
from jaxsense.run.kept import Kept
from jaxsense.run.monitor import Monitor

kept = Kept(Path(sys.argv[1]))
print("kept" if list(kept.path.iterdir()) else "new")
with Compiler(Monitor(), kept) as compiler:
    program = Program(compiler, "stage", "run")
    program.compile(jnp.linalg.cholesky, jax.ShapeDtypeStruct((2, 2), jnp.float32))
    print(program(jnp.array([[4.0, 2.0], [2.0, 5.0]])).tolist())
"""


@pytest.mark.slow
def test_a_kept_program_finds_the_functions_that_it_calls(tmp_path):
    # Only a new process has not bound them yet. [[2, 0], [1, 2]] times its transpose is the matrix.
    command = [sys.executable, "-c", FACTORS, str(tmp_path)]
    said = [subprocess.check_output(command, text=True) for _ in range(2)]
    expected = "[[2.0, 0.0], [1.0, 2.0]]\n"
    assert said == ["new\n" + expected, "kept\n" + expected]


def test_a_program_is_told_from_others_by_what_it_closes_over(tmp_path):
    kept = Kept(tmp_path)
    for factor in (2, 3, 2):
        found = kept.find_or_trace("stage", lambda x, f=factor: f * x, (ONE,), ("factor", factor))
        assert found is not None
        assert found(ONE) == factor
    assert len([*kept.path.iterdir()]) == 2


def test_the_oldest_programs_are_forgotten_and_no_other_file(tmp_path, monkeypatch):
    kept = Kept(tmp_path)
    names = "mission-go_on", "detector_Wärme-begin", "policies_lidar-begin", "jmvae-advance"
    paths = []
    for age, name in enumerate(names):
        kept.find_or_trace(name, lambda x: 2 * x, (ONE,))
        paths += [path for path in kept.path.iterdir() if path not in paths]
        os.utime(paths[-1], (age, age))
    assert kept.find_or_trace(names[0], never, (ONE,)) is not None  # used just now
    theirs = [tmp_path / "mine", kept.path / "mine", kept.path / f"stage-{32 * '0'}.stablehlo.txt"]
    for path in theirs:
        path.write_text("precious", encoding="utf-8")
    left = kept.path / ".a.0123456789abcdef.unfinished"
    left.write_text("{", encoding="utf-8")
    link = kept.path / f"stage-{32 * '1'}.stablehlo"
    link.symlink_to(theirs[0])
    monkeypatch.setattr("jaxsense.run.kept._MAX_KEPT", 2)
    Kept(tmp_path)
    assert [path.exists() for path in paths] == [True, False, False, True]
    assert all(path.exists() for path in (*theirs, link))
    assert not left.exists()


@pytest.mark.parametrize(
    "changed", ["vae/gaussian.py", "sim/arena.xml.jinja", "config/presets/raw.toml"]
)
def test_the_source_is_that_of_the_whole_package(tmp_path, changed):
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
    with (tmp_path / "jaxsense" / changed).open("a", encoding="utf-8") as file:
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


def test_all_compiled_programs_are_cached(tmp_path):
    entry = "jax_persistent_cache_min_"
    names = [f"jax_compilation_cache_{what}" for what in ("dir", "max_size")]
    names += [f"{entry}compile_time_secs", f"{entry}entry_size_bytes"]
    before = [jax.config.values[name] for name in names]
    try:
        jax.config.update(names[0], None)
        use_cache(tmp_path)
        found = [jax.config.values[name] for name in names]
    finally:
        for name, value in zip(names, before, strict=True):
            jax.config.update(name, value)
    assert found == [str(tmp_path / "compiled"), _MAX_BYTES, 0, -1]


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="has no users")
@pytest.mark.parametrize(("name", "begin"), [("compiled", use_cache), ("traced", Kept)])
def test_a_directory_of_others_is_refused(tmp_path, monkeypatch, name, begin):
    begin(tmp_path)
    match = f"{name} must be a directory that you own"
    own = os.getuid()
    with monkeypatch.context() as patch:
        patch.setattr(os, "getuid", lambda: own + 1)
        with pytest.raises(PermissionError, match=match):
            begin(tmp_path)
    (tmp_path / name).chmod(0o770)
    with pytest.raises(PermissionError, match=match):
        begin(tmp_path)
