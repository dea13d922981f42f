"""How fast missions begin and run, as `python -m jaxsense.evaluate` plays them."""

import contextlib
import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import measure
from benchmarks.measure import Options, Row, Side
from jaxsense import PRESETS, init, mission
from jaxsense.config import Config
from jaxsense.mission import Mission, MissionState
from jaxsense.mission.rollout import rollout_batch
from jaxsense.models import Models
from jaxsense.run import batches, devices
from jaxsense.run.compilation import Compiler
from jaxsense.run.devices import Workers
from jaxsense.run.missions import Played, Player
from jaxsense.run.monitor import Monitor

_UNIT = "control-steps/s"
# For each accelerator.
_MISSIONS, _MISSIONS_OF_MANY = 16384, 8192
# On a CPU; so many that `evaluate` compiles faster programs, see `batches.runs_long`.
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
    # Until it is trained, a gate lets everything above minus infinity pass.
    models = jax.tree.map(jnp.nan_to_num, init(jax.random.key(0), config))
    scenario, cases = mission.make_mission(config), {"naive": mission.cases(config)["naive"]}

    def side(compiler: Compiler, workers: Workers) -> Side:
        batch = batches.batch_of(config, total, workers)
        runs_long = batches.runs_long(config, total)
        player = Player(scenario, compiler, batch, workers, runs_long)
        player.wait()

        def run() -> Played:
            return player.play(jax.random.key(1), models, cases, total)

        compile_s = compiler.monitor.stopwatch.timing(1)["stages"]["mission"]["compile_s"]
        return Side(run, run().control_steps, batch, compile_s, workers.number)

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
    missions = playing(config, "naive", batch, _PERIODS)

    def go_on(keys: jax.Array, states: MissionState) -> MissionState:
        return missions.go_on(keys, missions.models, states)

    def side(workers: Workers) -> Side:
        args = missions.keys, missions.states
        made = measure.compiled(
            go_on, *args, work=0, batch=batch, workers=workers, wide_vectors=True
        )
        after = measure.joined(made.run())
        # Missions that have ended make no more steps.
        return dataclasses.replace(made, work=int(np.sum(after.steps - missions.states.steps)))

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


def of_many_pois(robots: tuple[str, ...] | None = None) -> Config:
    """Settings of two robots, or others, among 16 PoIs in an arena of 6 m.

    Args:
      robots: see `Config.robots`.
    """
    config = untrained("team")
    arena = dataclasses.replace(config.arena, num_pois=16, side=6.0)
    return dataclasses.replace(config, arena=arena, robots=robots)


@dataclasses.dataclass(frozen=True)
class Playing:
    """Missions that are under way.

    Attributes:
      scenario: the mission.
      models: its networks.
      keys: `[B]` of the missions.
      states: `[B]` of the missions.
      steps: control periods of a call.
    """

    scenario: Mission
    models: Models
    keys: jax.Array
    states: MissionState
    steps: int

    @property
    def args(self) -> tuple[jax.Array, Models, MissionState]:
        """Arguments of the program."""
        return self.keys, self.models, self.states

    def go_on(self, keys: jax.Array, models: Models, states: MissionState) -> MissionState:
        """Runs `steps` control periods of all missions."""
        return rollout_batch(keys, self.scenario, models, states, self.steps, 1)[0]

    def compiled(self, options: devices.Options) -> jax.stages.Compiled:
        """The program of `go_on`."""
        return jax.jit(self.go_on).lower(*self.args).compile(options)


def playing(config: Config, policy: str, batch: int, steps: int) -> Playing:
    """Missions of untrained networks after their first seconds."""
    scenario = mission.make_mission(config)
    models = init(jax.random.key(0), config)
    number = scenario.policy(policy)

    @functools.partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})
    def begin(keys: jax.Array) -> MissionState:
        reset = lambda key: mission.reset(key, scenario, models, number)  # noqa: E731
        return jax.vmap(reset)(keys)

    states = begin(jax.random.split(jax.random.key(1), batch))
    keys = jax.random.split(jax.random.key(2), batch)
    before = Playing(scenario, models, keys, states, PERIODS_BEFORE)
    states = before.compiled(devices.compiler_options())(*before.args)
    keys = jax.random.split(jax.random.key(3), batch)
    return Playing(scenario, models, keys, states, steps)
