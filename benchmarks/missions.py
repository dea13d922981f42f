"""How fast missions begin and run, as `python -m jaxsense.evaluate` plays them."""

import contextlib
import dataclasses
import functools

import jax
import numpy as np

from benchmarks import measure
from benchmarks.measure import Options, Row, Side
from jaxsense import PRESETS, init, mission
from jaxsense.config import Config
from jaxsense.mission import MissionState
from jaxsense.mission.rollout import rollout_batch
from jaxsense.run import devices
from jaxsense.run.compilation import Compiler
from jaxsense.run.devices import Workers
from jaxsense.run.missions import Played, Player
from jaxsense.run.monitor import Monitor

_UNIT = "control-steps/s"
# For each accelerator.
_MISSIONS, _MISSIONS_OF_MANY = 16384, 8192
# On a CPU; so many that `evaluate` compiles faster programs, see `missions.Player`.
_OF_CPU, _OF_CPU_OF_MANY = 5632, 1024
PERIODS_BEFORE = 40
"""Control periods before what is measured under way: 4 s of missions that last 14 s."""
_PERIODS = 20  # to measure


def missions(options: Options) -> Row:
    """Missions of the policy `naive` with the settings of `default`, from begin to end."""
    return _play("missions", options, untrained("default"), _MISSIONS, _OF_CPU)


def missions_many(options: Options) -> Row:
    """The same with 16 PoIs in an arena of 6 m."""
    return _play("missions_many", options, of_many_pois(), _MISSIONS_OF_MANY, _OF_CPU_OF_MANY)


def missions_under_way(options: Options) -> Row:
    """Control steps of missions of `missions` that are all under way, without begin and end."""
    return _go_on("missions_under_way", options, untrained("default"), _MISSIONS)


def missions_many_under_way(options: Options) -> Row:
    """The same with 16 PoIs in an arena of 6 m."""
    return _go_on("missions_many_under_way", options, of_many_pois(), _MISSIONS_OF_MANY)


def missions_under_way_devices(options: Options) -> Row:
    """`missions_under_way` on all devices, against one of them."""
    config = untrained("default")
    return _go_on("missions_under_way_devices", options, config, _MISSIONS, against_one=True)


def missions_many_under_way_devices(options: Options) -> Row:
    """`missions_many_under_way` on all devices, against one of them."""
    name, config = "missions_many_under_way_devices", of_many_pois()
    return _go_on(name, options, config, _MISSIONS_OF_MANY, against_one=True)


def missions_devices(options: Options) -> Row:
    """`missions` on all devices, against one of them that plays the same ones."""
    config = untrained("default")
    return _play("missions_devices", options, config, _MISSIONS, _OF_CPU, against_one=True)


def missions_many_devices(options: Options) -> Row:
    """`missions_many` on all devices, against one of them that plays the same ones."""
    name, config, on_cpu = "missions_many_devices", of_many_pois(), _OF_CPU_OF_MANY
    return _play(name, options, config, _MISSIONS_OF_MANY, on_cpu, against_one=True)


def _play(
    name: str,
    options: Options,
    config: Config,
    accelerator: int,
    cpu: int,
    against_one: bool = False,
) -> Row:
    """As many missions as each accelerator plays at once, or fewer on a CPU."""
    devices_of_sides, number = _sides(against_one)
    (total,) = measure.batches(options, quick=4, cpu=(cpu,), accelerator=(number * accelerator,))
    models = init(jax.random.key(0), config)
    scenario, cases = mission.make_mission(config), {"naive": mission.cases(config)["naive"]}

    def side(compiler: Compiler, workers: Workers) -> Side:
        player = Player(scenario, compiler, total, workers)
        player.wait()

        def run() -> Played:
            return player.play(jax.random.key(1), models, cases, total)

        compile_s = compiler.monitor.timing()["stages"]["mission"]["compile_s"]
        return Side(run, run().control_steps, player.batch, compile_s, workers.number)

    with contextlib.ExitStack() as stack:
        ours, *theirs = (
            side(stack.enter_context(Compiler(Monitor())), workers) for workers in devices_of_sides
        )
        peer = "one device" if against_one else None
        return measure.compare(name, _UNIT, [ours], theirs, options, peer=peer)


def _go_on(
    name: str, options: Options, config: Config, accelerator: int, against_one: bool = False
) -> Row:
    """Some control periods of missions after their first seconds."""
    devices_of_sides, number = _sides(against_one)
    (batch,) = measure.batches(options, quick=4, cpu=(384,), accelerator=(number * accelerator,))
    scenario, models = mission.make_mission(config), init(jax.random.key(0), config)
    policy = scenario.policy("naive")

    @functools.partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})
    def begin(keys: jax.Array) -> MissionState:
        return jax.vmap(lambda key: mission.reset(key, scenario, models, policy))(keys)

    def play(keys: jax.Array, states: MissionState, periods: int) -> MissionState:
        return rollout_batch(keys, scenario, models, states, periods, 1)[0]

    start_keys, keys_before, keys = (jax.random.split(jax.random.key(i), batch) for i in (1, 2, 3))
    before = jax.jit(play, static_argnums=2, compiler_options=devices.compiler_options())
    states = before(keys_before, begin(start_keys), PERIODS_BEFORE)

    def side(workers: Workers) -> Side:
        go_on = functools.partial(play, periods=_PERIODS)
        options = {"batch": batch, "workers": workers, "wide_vectors": True}
        made = measure.compiled(go_on, keys, states, work=0, **options)
        after = measure.joined(made.run())
        # Missions that have ended make no more steps.
        return dataclasses.replace(made, work=int(np.sum(after.steps - states.steps)))

    ours, *theirs = map(side, devices_of_sides)
    peer = "one device" if against_one else None
    return measure.compare(name, _UNIT, [ours], theirs, options, peer=peer)


def _sides(against_one: bool) -> tuple[list[Workers], int]:
    """All devices, perhaps also one of them; and the number of accelerators, 1 for a CPU."""
    of_sides = [devices.start(None)] + [devices.start(1)] * against_one
    return of_sides, 1 if jax.default_backend() == "cpu" else jax.device_count()


def resets_many(options: Options) -> Row:
    """The beginning of missions with 16 PoIs in an arena of 6 m."""
    sizes = measure.batches(options, quick=2, cpu=(64, 384), accelerator=(8192,))
    config = of_many_pois()
    scenario, models = mission.make_mission(config), init(jax.random.key(0), config)

    def reset(key: jax.Array) -> MissionState:
        return mission.reset(key, scenario, models)

    sides = [
        measure.compiled(
            jax.vmap(reset),
            jax.random.split(jax.random.key(1), batch),
            work=batch,
            batch=batch,
            workers=devices.start(None),
            wide_vectors=True,
        )
        for batch in sizes
    ]
    return measure.compare("resets_many", "resets/s", sides, [], options)


def untrained(preset: str) -> Config:
    """Settings of missions in which untrained detectors count as confident."""
    config = PRESETS[preset]
    settings = dataclasses.replace(config.mission, least_confidence=0.0)
    return dataclasses.replace(config, mission=settings)


def of_many_pois() -> Config:
    """Settings of two robots among 16 PoIs in an arena of 6 m."""
    config = untrained("team")
    arena = dataclasses.replace(config.arena, num_pois=16, side=6.0)
    return dataclasses.replace(config, arena=arena)
