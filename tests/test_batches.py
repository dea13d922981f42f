"""How many missions play side by side."""

from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import jax
import pytest

import jaxsense
from jaxsense import mission
from jaxsense.config import PRESETS, CommunicationConfig, ConfigError
from jaxsense.run import batches, devices
from jaxsense.run.devices import Workers

CONFIG = PRESETS["default"]
MANY = replace(CONFIG, arena=replace(CONFIG.arena, num_pois=16, side=6.0))
GIB = 2**30


def crowded(config, num_pois=64, robots=32, own_maps=True):
    """Settings of missions with the most PoIs and robots, or with fewer."""
    own = replace(config.mission, communication=CommunicationConfig(own_maps=own_maps))
    return replace(
        config,
        arena=replace(config.arena, num_pois=num_pois, side=10.0),
        robots=robots * ("camera", "lidar"),
        jmvae=replace(config.jmvae, fusion="filter"),
        mission=own,
    )


LARGEST = crowded(PRESETS["many"])


def bytes_of_state(config):
    """Bytes of a mission's state, without simulating one."""
    scenario = mission.make_mission(config)

    def begin(key):
        return mission.reset(key, scenario, jaxsense.init(key, config))

    state = jax.eval_shape(begin, jax.random.key(0))
    return sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(state))


def test_a_cpu_plays_what_its_caches_hold_and_at_most_a_third_at_once():
    assert batches.batch_of(CONFIG, 10_000) == 192
    assert batches.batch_of(CONFIG, 10_000, Workers(threads=2)) == 384
    assert batches.batch_of(CONFIG, 30, Workers(threads=2)) == 10
    assert batches.batch_of(CONFIG, 1) == 1
    # A roadmap of 60 PoIs takes 2.6 MB, of which 64 MiB hold 25.
    large = replace(MANY, arena=replace(MANY.arena, num_pois=60, side=20.0))
    assert batches.batch_of(large, 10_000) == 25


@pytest.mark.parametrize(
    "config",
    [
        pytest.param(MANY, id="PoIs"),
        pytest.param(crowded(CONFIG, num_pois=16, own_maps=False), id="robots"),
        pytest.param(crowded(CONFIG, num_pois=8), id="maps"),
        pytest.param(LARGEST, id="largest", marks=pytest.mark.slow),
    ],
)
def test_what_is_counted_is_what_a_mission_takes(config):
    assert batches._bytes_of_state(config) == pytest.approx(bytes_of_state(config), rel=0.1)


def test_the_largest_missions_fit_into_the_memory(monkeypatch):
    of_one = batches._bytes_of_state(LARGEST)
    assert of_one < GIB // 32
    assert batches.batch_of(LARGEST, 10**6) == 8  # a quarter of a GiB
    for memory in (GIB, 80 * GIB):
        monkeypatch.setattr(devices, "memory", lambda: memory)  # noqa: B023
        batch = batches.batch_of(LARGEST, 10**6)
        assert 1 < batch <= 0.05 * memory / of_one < batch + 1
    monkeypatch.setattr(devices, "memory", lambda: 2 * of_one)
    assert batches.batch_of(LARGEST, 10**6) == 1


@pytest.mark.parametrize(
    ("larger", "expected"),
    [
        ({"num_pois": 65}, "arena.num_pois = 65: must be from 1 to 64"),
        ({"robots": 33}, r"robots = \('camera', .*: must have 1 to 64 values"),
    ],
)
def test_missions_that_are_larger_are_refused(larger, expected):
    # One line: the dot stands for no line break.
    with pytest.raises(ConfigError, match=f"^{expected}$"):
        crowded(PRESETS["many"], **larger)


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


@pytest.mark.parametrize("stats", [None, {}, {"bytes_limit": 7 * GIB}])
def test_an_accelerator_may_not_tell_its_memory(monkeypatch, stats):
    assert devices.memory() is None
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    monkeypatch.setattr(jax, "local_devices", lambda: [SimpleNamespace(memory_stats=lambda: stats)])
    assert devices.memory() == (stats or {"bytes_limit": 8 * GIB})["bytes_limit"]


def test_the_smaller_of_two_accelerators_counts(monkeypatch):
    tell = [partial(dict, bytes_limit=n * GIB) for n in (9, 7)]
    cards = [SimpleNamespace(memory_stats=each) for each in tell]
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    monkeypatch.setattr(jax, "local_devices", lambda: cards)
    assert devices.memory() == 7 * GIB


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
