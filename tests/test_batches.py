"""How many missions play side by side."""

from dataclasses import replace

import jax
import pytest

from jaxsense.config import PRESETS
from jaxsense.run import batches, devices
from jaxsense.run.devices import Workers

CONFIG = PRESETS["default"]
MANY = replace(CONFIG, arena=replace(CONFIG.arena, num_pois=16, side=6.0))
GIB = 2**30


def test_a_cpu_plays_what_its_caches_hold_and_at_most_a_third_at_once():
    assert batches.batch_of(CONFIG, 10_000) == 192
    assert batches.batch_of(CONFIG, 10_000, Workers(threads=2)) == 384
    assert batches.batch_of(CONFIG, 30, Workers(threads=2)) == 10
    assert batches.batch_of(CONFIG, 1) == 1
    # A roadmap of 60 PoIs takes 2.6 MB, of which 64 MiB hold 25.
    crowded = replace(MANY, arena=replace(MANY.arena, num_pois=60, side=20.0))
    assert batches.batch_of(crowded, 10_000) == 25


@pytest.mark.parametrize(
    ("memory", "total", "expected"),
    [
        (80 * GIB, 100, 100),  # all
        (80 * GIB, 32_768, 16_384),  # sqrt(8192 * 32,768)
        (80 * GIB, 10**6, 32_768),  # no more pay
        (GIB // 2, 10**6, None),  # what fits into a twentieth of the memory
    ],
)
def test_an_accelerator_plays_more_the_more_there_are(monkeypatch, memory, total, expected):
    monkeypatch.setattr(devices, "memory", lambda: memory)
    found = batches.batch_of(CONFIG, total)
    if expected is None:
        expected = int(0.05 * memory) // batches._bytes_of_state(CONFIG)
        assert 1 < expected < 32_768
    assert found == expected


def test_two_accelerators_play_twice_what_one_holds(monkeypatch):
    monkeypatch.setattr(devices, "memory", lambda: 80 * GIB)
    both = Workers(mesh=devices.make_mesh(2))
    assert batches.batch_of(CONFIG, 10**7, both) == 65_536
    # sqrt(8192 * 32,768 * 2)
    assert batches.batch_of(CONFIG, 32_768, both) == 23_170


def test_missions_run_long_if_many_pois_are_to_be_looked_at():
    assert not batches.runs_long(CONFIG, 5_461)  # of 3 PoIs, 16,383
    assert batches.runs_long(CONFIG, 5_462)
    assert batches.runs_long(MANY, 1_024)


def test_wide_vectors_are_for_a_cpu_alone(monkeypatch):
    monkeypatch.setattr(devices, "_is_known", lambda name, value: True)
    jax.config.update("jax_disable_most_optimizations", False)
    try:
        assert devices.compiler_options(wide_vectors=True)["xla_cpu_prefer_vector_width"] == 512
        assert "xla_cpu_prefer_vector_width" not in devices.compiler_options()
        monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
        assert "xla_cpu_prefer_vector_width" not in devices.compiler_options(wide_vectors=True)
    finally:
        jax.config.update("jax_disable_most_optimizations", True)


def test_passes_over_loops_run_only_in_programs_that_run_long_on_a_cpu(monkeypatch):
    monkeypatch.setattr(devices, "_is_known", lambda name, value: True)
    jax.config.update("jax_disable_most_optimizations", False)
    try:
        assert "code-motion" in devices.compiler_options()["xla_disable_hlo_passes"]
        assert "xla_disable_hlo_passes" not in devices.compiler_options(runs_long=True)
        monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
        assert "xla_disable_hlo_passes" not in devices.compiler_options()
    finally:
        jax.config.update("jax_disable_most_optimizations", True)
