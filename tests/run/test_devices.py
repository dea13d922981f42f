"""Work split over devices gives what one device gives."""

import os
import subprocess
import sys
import threading

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from same_figures import different_across_compilers
from smoke import SMOKE, error_line, without_times

from jaxsense import train
from jaxsense.config import PRESETS, ConfigError
from jaxsense.run import devices
from jaxsense.run.compilation import Compiler, Program, RowProgram
from jaxsense.run.devices import Workers
from jaxsense.run.kept import Kept, trace
from jaxsense.run.monitor import Monitor
from jaxsense.sim import arena as arenas

CONFIG = PRESETS["smoke"]


def test_a_spread_function_gives_what_it_gives_alone():
    mesh = devices.make_mesh(2)

    def function(x, scale):
        return {"sum": x.sum(axis=1) * scale, "x": x}

    x = jnp.arange(12.0).reshape(6, 2)
    spread = jax.jit(devices.spread(lambda scale, x: function(x, scale), mesh, 2, whole=1))
    chex.assert_trees_all_close(spread(jnp.float32(3), x), function(x, jnp.float32(3)))
    assert spread(jnp.float32(3), x)["sum"].sharding.num_devices == 2


def drive(speeds):
    """`[B, 3 R]` velocities after a step of the physics with `[B, R, 2]` wheel speeds."""
    arena = arenas.build(CONFIG.arena, (False, True), obstacles=False)
    return jax.vmap(lambda s: arenas.drive(arena, arena.data, s).qvel)(speeds)


SPEEDS = np.arange(16.0, dtype=np.float32).reshape(4, 2, 2)


@pytest.mark.slow
def test_a_step_of_the_physics_is_spread_over_two_host_devices():
    # If `shard_map` saw its constants, jaxlib 0.11.2 would crash while it compiles this.
    alone = trace(drive, (SPEEDS[:2],))
    together = jax.jit(devices.spread(alone.__call__, devices.make_mesh(2), 1))(SPEEDS)
    assert together.sharding.num_devices == 2
    np.testing.assert_allclose(together, jax.jit(drive)(SPEEDS), rtol=1e-5)


@pytest.mark.parametrize(
    "make", [lambda: Workers(threads=3), Workers, lambda: Workers(mesh=devices.make_mesh(2))]
)
@pytest.mark.parametrize("is_kept", [False, True])
def test_workers_share_the_rows_of_a_program(make, is_kept, tmp_path):
    workers, seen = make(), []

    def function(scale, x):
        seen.append(x.shape)
        return {"scaled": scale * x, "sums": x.sum(axis=1)}

    scale, x = jnp.float32(2), np.arange(12.0, dtype=np.float32).reshape(6, 2)
    kept = Kept(tmp_path / "cache") if is_kept else None
    with Compiler(Monitor(), kept) as compiler:
        program = RowProgram(Program(compiler, "stage", "run"), workers)
        shapes = program.compile(function, scale, x, whole=1)
        output = program(scale, x)
    assert seen == [(6 // workers.number, 2)]
    assert (shapes["scaled"].shape, shapes["sums"].shape) == ((6, 2), (6,))
    np.testing.assert_array_equal(output["scaled"], 2 * x)
    np.testing.assert_array_equal(output["sums"], [1, 5, 9, 13, 17, 21])


@pytest.mark.slow  # compiles a whole run
def test_two_devices_share_a_run(tmp_path, monkeypatch, smoke_run):
    monkeypatch.setattr(devices, "start", lambda _: Workers(mesh=devices.make_mesh(2)))
    cache = ["--cache", str(tmp_path / "cache")]
    for name in ("shared", "again"):  # the second time with the programs of the first
        train.main([*SMOKE, *cache, "--out", str(tmp_path / name)])
        found = without_times(tmp_path / name)
        assert not different_across_compilers(found, without_times(smoke_run))


@pytest.mark.slow
def test_functions_of_the_library_leave_the_process_as_it_was(tmp_path):
    code = """
import gc, os, sys, warnings
from pathlib import Path
import jax
import scipy.stats  # whose import filters warnings
import jaxsense
from jaxsense.run import devices, kept

def state():
    return dict(os.environ), dict(jax.config.values), gc.get_threshold(), warnings.filters[:]

before = state()
devices.threads()
devices.compiler_options()
kept.Kept(Path(sys.argv[1]))
task = jaxsense.make("map-v0", "camera")
jaxsense.score(task, lambda key, observation: jax.numpy.int32(3), episodes=2)
jaxsense.load_pretrained("noisy")
assert state() == before
"""
    environment = {name: value for name, value in os.environ.items() if name != "NPROC"}
    subprocess.run([sys.executable, "-c", code, str(tmp_path)], check=True, env=environment)


def test_a_number_of_devices_that_cannot_be_is_named(monkeypatch, capsys):
    for number in ("0", "-1", str(10**9)):
        line = error_line(["--devices", number], capsys)
        assert f"devices = {number}: must be a whole number, from 1 to 256" in line
    assert devices.start(3) == Workers(threads=3)
    assert devices.start(None).number == min(devices.cores(), 8)
    # The two devices of these tests, as if they were accelerators.
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    with pytest.raises(ConfigError, match=r"devices = 3: must be from 1 to 2"):
        devices.start(3)
    assert devices.start(1) == Workers()
    workers = devices.start(None)
    assert workers.mesh.size == workers.number == 2


@pytest.mark.parametrize("error", [KeyboardInterrupt, ValueError])
def test_calls_are_asked_to_end_when_one_fails(error):
    stopped = threading.Event()

    def call(i):
        if i:
            raise error
        assert stopped.wait(10)

    with pytest.raises(error):
        devices.side_by_side(call, [0, 1], 2, fail=lambda error: stopped.set())


DECOMPOSED = """
import os, jax, jax.numpy as jnp
from jaxsense.run import devices, output

def main():
    workers = devices.start(2)
    matrices = jnp.stack([jnp.eye(18)] * 288)
    again = lambda _, x: jnp.linalg.cholesky(x @ x)
    program = jax.jit(lambda x: jax.lax.fori_loop(0, 100, again, x)).lower(matrices).compile()
    for _ in range(3):
        each = lambda x: jax.block_until_ready(program(x))
        devices.side_by_side(each, [matrices] * workers.threads, workers.threads)
    print(workers.threads)

output.run(main)
"""


@pytest.mark.slow
def test_programs_side_by_side_do_not_wait_for_each_other_for_ever():
    # Cholesky decompositions as in the physics of six robots.
    environment = {name: value for name, value in os.environ.items() if name != "NPROC"}
    command = [sys.executable, "-c", DECOMPOSED]
    told = subprocess.check_output(command, env=environment, timeout=120, text=True)
    assert int(told) == 2


def test_jax_takes_over_what_parts_are_joined_in():
    whole = devices.empty(jax.ShapeDtypeStruct((6, 5), jnp.float32))
    assert (whole.shape, whole.dtype) == ((6, 5), np.float32)
    assert jax.device_put(whole).unsafe_buffer_pointer() == whole.ctypes.data
