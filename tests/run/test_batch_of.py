"""How many missions play side by side."""

from dataclasses import replace

import jax
import pytest

import jaxsense
from jaxsense import mission
from jaxsense.config import PRESETS
from jaxsense.config.mission import CommunicationConfig
from jaxsense.run import devices, missions
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
    assert missions.batch_of(CONFIG, 10_000) == 192
    assert missions.batch_of(CONFIG, 10_000, Workers(threads=2)) == 384
    assert missions.batch_of(CONFIG, 30, Workers(threads=2)) == 10
    assert missions.batch_of(CONFIG, 1) == 1
    # A roadmap of 60 PoIs takes 2.6 MB, of which 64 MiB hold 25.
    large = replace(MANY, arena=replace(MANY.arena, num_pois=60, side=20.0))
    assert missions.batch_of(large, 10_000) == 25


@pytest.mark.slow  # traces the start of large missions
@pytest.mark.parametrize(
    "config",
    [
        pytest.param(crowded(CONFIG, num_pois=8), id="maps"),
        pytest.param(LARGEST, id="largest"),
    ],
)
def test_what_is_counted_is_what_a_mission_takes(config):
    assert missions._bytes_of_state(config) == pytest.approx(bytes_of_state(config), rel=0.1)


OF_ONE = missions._bytes_of_state(CONFIG)
MESH = lambda: Workers(mesh=devices.make_mesh(2))  # noqa: E731


@pytest.mark.parametrize(
    ("config", "memory", "total", "workers", "expected"),
    [
        (CONFIG, 80 * GIB, 100, Workers, 100),  # all
        (CONFIG, 80 * GIB, 32_768, Workers, 16_384),  # sqrt(8192 * 32,768)
        (CONFIG, 80 * GIB, 10**6, Workers, 32_768),  # no more pay
        (CONFIG, GIB // 2, 10**6, Workers, int(0.05 * GIB / 2) // OF_ONE),
        (CONFIG, 80 * GIB, 10**7, MESH, 65_536),
        (CONFIG, 80 * GIB, 32_768, MESH, 23_170),  # sqrt(8192 * 32,768 * 2)
        (LARGEST, 2 * missions._bytes_of_state(LARGEST), 10**6, Workers, 1),
    ],
)
def test_an_accelerator_plays_what_pays_and_fits(
    config, memory, total, workers, expected, monkeypatch
):
    monkeypatch.setattr(devices, "memory", lambda: memory)
    assert missions.batch_of(config, total, workers()) == expected
