"""Work split over devices and over processes gives what one device gives."""

import json
import os
import socket
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsense import devices, models, observe
from jaxsense.compilation import Compiler, Program
from jaxsense.config import PRESETS, ConfigError, DqnConfig
from jaxsense.devices import Workers
from jaxsense.dqn import training
from jaxsense.monitor import Monitor
from jaxsense.sim import arena as arenas

ROOT = Path(__file__).parents[1]
SETTINGS = DqnConfig(
    observe="bank",
    num_envs=16,
    epochs=30,
    chunk=15,
    updates=2,
    batch=32,
    replay_capacity=256,
    num_starts=32,
    target_period=10,
)
CONFIG = replace(PRESETS["smoke"], dqn=SETTINGS)
# Sums of gradients in another order; float32, 60 steps of Adam.
TOLERANCE = 1e-4


def train(mesh):
    """Parameters and losses of the camera's agent, from random detections."""
    shape = models.jmvae_shape(CONFIG)
    params = models.untrained(jax.random.key(0), CONFIG).jmvae
    bank = tuple(jax.random.uniform(k, (3, 50, 2)) for k in jax.random.split(jax.random.key(1)))
    mdp = observe.bank_mdp(CONFIG, bank, params, shape)
    state, info = training.train(jax.random.key(2), mdp, 0, SETTINGS, mesh)
    return state.params, info


@pytest.fixture(scope="module")
def alone():
    return jax.jit(lambda: train(None))()


def test_two_devices_learn_what_one_learns(alone):
    mesh = devices.make_mesh(2)
    together = jax.jit(lambda: train(mesh))()
    chex.assert_trees_all_close(together, alone, atol=TOLERANCE)
    start = jax.jit(lambda: training.train(jax.random.key(2), *initial(), mesh)[0].params)()
    moved = jax.tree.map(lambda x, y: np.abs(x - y).max(), start, alone[0])
    assert max(jax.tree.leaves(moved)) > 10 * TOLERANCE  # there was something to learn


def initial():
    """The same training, but of a single epoch."""
    settings = replace(SETTINGS, epochs=1, chunk=1)
    config = replace(CONFIG, dqn=settings)
    params = models.untrained(jax.random.key(0), config).jmvae
    bank = tuple(jax.random.uniform(k, (3, 50, 2)) for k in jax.random.split(jax.random.key(1)))
    return observe.bank_mdp(config, bank, params, models.jmvae_shape(config)), 0, settings


@pytest.mark.slow  # compiles the same training three times
def test_two_processes_train_together_and_stop(alone):
    with socket.socket() as free:
        free.bind(("localhost", 0))
        address = f"localhost:{free.getsockname()[1]}"
    program = f"""
import json, sys
import jax
jax.config.update("jax_num_cpu_devices", 1)
jax.distributed.initialize({address!r}, 2, int(sys.argv[1]))
sys.path.insert(0, {str(ROOT / "tests")!r})
import numpy as np
from jaxsense import devices
from test_devices import train
assert (jax.process_count(), jax.device_count(), jax.local_device_count()) == (2, 2, 1)
mesh = devices.make_mesh()
params, info = jax.jit(lambda: train(mesh))()
print(json.dumps([np.asarray(x).tolist() for x in jax.tree.leaves((params, info))]))
jax.distributed.shutdown()
"""
    environment = {**os.environ, "JAX_PLATFORMS": "cpu"}
    processes = [
        subprocess.Popen(
            [sys.executable, "-c", program, str(i)],
            env=environment,
            cwd=ROOT,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for i in range(2)
    ]
    outputs = [process.communicate(timeout=240) for process in processes]
    for process, (_, errors) in zip(processes, outputs, strict=True):
        assert process.returncode == 0, errors
    for text, _ in outputs:
        leaves = [np.array(leaf, np.float32) for leaf in json.loads(text.splitlines()[-1])]
        for here, there in zip(leaves, jax.tree.leaves(alone), strict=True):
            np.testing.assert_allclose(here, np.asarray(there), atol=TOLERANCE)


def test_a_spread_function_gives_what_it_gives_alone():
    mesh = devices.make_mesh(2)

    def function(x, scale):
        return {"sum": x.sum(axis=1) * scale, "x": x}

    x = jnp.arange(12.0).reshape(6, 2)
    spread = jax.jit(devices.spread(function, mesh, whole=(1,)))
    chex.assert_trees_all_close(spread(x, jnp.float32(3)), function(x, jnp.float32(3)))
    assert spread(x, jnp.float32(3))["sum"].sharding.num_devices == 2
    assert devices.spread(function, None) is function


def test_a_step_of_the_physics_is_spread_over_two_host_devices():
    # Under `shard_map`, jaxlib 0.11.2 crashes while it compiles this.
    arena = arenas.build(CONFIG.arena, (False, True), obstacles=False)

    def drive(speeds):
        return jax.vmap(lambda s: arenas.drive(arena, arena.data, s).qvel)(speeds)

    speeds = jnp.arange(16.0).reshape(4, 2, 2)
    together = jax.jit(devices.spread(drive, devices.make_mesh(2)))(speeds)
    assert together.sharding.num_devices == 2
    np.testing.assert_allclose(together, jax.jit(drive)(speeds), rtol=1e-5)


@pytest.mark.parametrize("workers", [Workers(threads=3), Workers(mesh=None)])
def test_workers_share_the_rows_of_a_program(workers):
    seen = []

    def function(scale, x):
        seen.append(x.shape)
        return {"scaled": scale * x, "sums": x.sum(axis=1)}

    scale, x = jnp.float32(2), np.arange(12.0, dtype=np.float32).reshape(6, 2)
    with Compiler(Monitor()) as compiler:
        program = Program(compiler, "stage", "run")
        shapes = program.compile(function, scale, x, workers=workers, whole=(0,))
        output = program(scale, x)
    assert seen == [(6 // workers.number, 2)]
    assert program.num_workers == workers.number
    assert (shapes["scaled"].shape, shapes["sums"].shape) == ((6, 2), (6,))
    np.testing.assert_array_equal(output["scaled"], 2 * x)
    np.testing.assert_array_equal(output["sums"], [1, 5, 9, 13, 17, 21])


def test_options_that_the_compiler_does_not_know_are_left_out():
    assert devices.compiler_options() == {}  # tests compile without optimisation
    jax.config.update("jax_disable_most_optimizations", False)
    try:
        known = devices.compiler_options(runs_long=True)
    finally:
        jax.config.update("jax_disable_most_optimizations", True)
    assert known["xla_backend_optimization_level"] == 1
    assert not devices._is_known("xla_no_such_option", 1)
    jax.jit(lambda x: x).lower(1.0).compile(compiler_options=known)


def test_a_number_of_devices_that_cannot_be_is_named(monkeypatch):
    for number in (0, -1, 10**9):
        with pytest.raises(ConfigError, match=rf"devices = {number}: must be within 1 and 256"):
            devices.start(number, SETTINGS)
    with pytest.raises(ValueError, match="devices = 0"):
        devices.make_mesh(0)
    assert devices.start(3, SETTINGS) == (Workers(threads=3), None)
    threads, learners = devices.start(None)
    assert (threads.number, learners) == (min(os.cpu_count(), 8), None)
    # The two devices of these tests, as if they were accelerators.
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    with pytest.raises(ConfigError, match=r"devices = 3: must be within 1 and 2"):
        devices.start(3, SETTINGS)
    odd = replace(SETTINGS, num_envs=15, replay_capacity=150, num_starts=30)
    with pytest.raises(ConfigError, match=r"devices = 2: must divide 1, .* dqn.num_envs = 15 and"):
        devices.start(2, odd)
    assert devices.start(None, odd) == (Workers(), None)
    workers, learners = devices.start(None, SETTINGS)
    assert workers.mesh.size == workers.number == learners.size == 2
