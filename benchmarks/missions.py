"""How fast missions begin and run, as `python -m jaxsense.evaluate` plays them."""

import dataclasses
import functools
from typing import Any

import jax

from jaxsense import PRESETS, init, mission
from jaxsense.config import Config
from jaxsense.mission import Mission, MissionState
from jaxsense.mission.rollout import rollout_batch
from jaxsense.models import Models

_PERIODS_BEFORE = 40  # 4 s of missions that last 14 s


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
    def args(self) -> tuple[Any, ...]:
        """Arguments of the program."""
        return self.keys, self.models, self.states

    def go_on(self, keys: jax.Array, models: Models, states: MissionState) -> MissionState:
        """Runs `steps` control periods of all missions."""
        return rollout_batch(keys, self.scenario, models, states, self.steps, len(keys))[0]

    def compiled(self, options: dict[str, Any]) -> jax.stages.Compiled:
        """The program of `go_on`."""
        return jax.jit(self.go_on).lower(*self.args).compile(options)


def untrained(preset: str) -> Config:
    """Settings of missions in which untrained detectors count as confident."""
    config = PRESETS[preset]
    settings = dataclasses.replace(config.mission, least_confidence=0.0)
    return dataclasses.replace(config, mission=settings)


@functools.cache
def playing(preset: str, policy: str, batch: int, steps: int) -> Playing:
    """Missions of untrained networks after their first seconds."""
    config = untrained(preset)
    scenario = mission.make_mission(config)
    models = init(jax.random.key(0), config)
    number = scenario.policy(policy)

    @functools.partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})
    def begin(keys: jax.Array) -> MissionState:
        reset = lambda key: mission.reset(key, scenario, models, number)  # noqa: E731
        return jax.vmap(reset)(keys)

    states = begin(jax.random.split(jax.random.key(1), batch))
    keys = jax.random.split(jax.random.key(2), batch)
    before = Playing(scenario, models, keys, states, _PERIODS_BEFORE)
    states = before.compiled({"xla_backend_optimization_level": 1})(*before.args)
    keys = jax.random.split(jax.random.key(3), batch)
    return Playing(scenario, models, keys, states, steps)
