"""Moments of missions in which a robot chooses, with all that its programs read there."""

import dataclasses
import functools
from collections.abc import Callable, Iterator

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from jaxsense import mission
from jaxsense.config import Config
from jaxsense.mission import decide
from jaxsense.mission.choice import ask, choose
from jaxsense.mission.maps import OwnMap, SharedMap, map_of
from jaxsense.mission.memory import Memory
from jaxsense.mission.state import ENDED, FAILED, Mission, MissionState
from jaxsense.models import Models
from jaxsense.run import devices
from jaxsense.sim import arena as arenas
from jaxsense.sim import sensors, viewpoints

_MISSIONS = 16

Inputs = dict[str, np.ndarray]


@dataclasses.dataclass(frozen=True)
class Choice:
    """A moment in which a robot chooses.

    Attributes:
      inputs: of `decide`.
      action: that the robot of the mission takes.
      seen: `[N, M]` bool, sensors that have looked at each PoI.
      poi: the nearest PoI.
      readings: a whole scan.
      bearing: of the nearest PoI, in radians.
      distance: of the nearest PoI, in metres.
      sums: `[R, N, C]` of the looks of each robot that this one knows of; None for a shared map.
    """

    inputs: Inputs
    action: int
    seen: np.ndarray
    poi: int
    readings: np.ndarray
    bearing: np.ndarray
    distance: np.ndarray
    sums: np.ndarray | None


def choices(config: Config, models: Models, number: int, seed: int = 0) -> list[Choice]:
    """Moments of missions with the trained policy, in which a robot is at work and must choose.

    Args:
      config: settings of the run.
      models: its models.
      number: how many.
      seed: of the arenas.
    """
    made = mission.make_mission(config)
    # Only the policy that plays, which makes compiling faster.
    scenario = dataclasses.replace(made, policies={"latent": made.policies["latent"]})
    keys = jax.random.split(jax.random.key(seed), _MISSIONS)
    begin = jax.jit(jax.vmap(lambda key: mission.reset(key, scenario, models)))

    @functools.partial(jax.jit, compiler_options=devices.compiler_options())
    def advance(keys: jax.Array, states: MissionState) -> MissionState:
        return mission.rollout_batch(keys, scenario, models, states, 1, 1)[0]

    observe = [
        jax.jit(jax.vmap(_observer(scenario, models, robot)))
        for robot in range(len(config.carried))
    ]
    found: list[Choice] = []
    round_ = 0
    while len(found) < number:
        states = begin(jax.vmap(lambda key: jax.random.fold_in(key, round_))(keys))  # noqa: B023
        step = 0
        while not states.done.all() and len(found) < number:
            step_keys = jax.vmap(lambda key: jax.random.fold_in(key, 1000 + step))(keys)  # noqa: B023
            for each in observe:
                found += _rows(jax.tree.map(np.asarray, each(step_keys, states)))
            states = advance(step_keys, states)
            step += 1
        round_ += 1
    return found[:number]


def _rows(seen: tuple[np.ndarray, dict[str, PyTree]]) -> Iterator[Choice]:
    is_due, choice = seen
    for row in np.flatnonzero(is_due):
        yield Choice(**jax.tree.map(lambda x: x[row], choice))  # noqa: B023


def _observer(
    scenario: Mission, models: Models, robot: int
) -> Callable[[jax.Array, MissionState], tuple[jax.Array, dict[str, PyTree]]]:
    config, index, policy = scenario.config, jnp.int32(robot), scenario.policies["latent"]
    sensor = scenario.world.sensors[config.modality_of_robot[robot]]

    def observe(key: jax.Array, state: MissionState) -> tuple[jax.Array, dict[str, PyTree]]:
        robots, scene = state.robots, state.scene
        given_up = robots.unreachable | robots.undetected | robots.exhausted
        phase, position = robots.phase, scene.layout.position
        away = jnp.linalg.norm(position - scene.poses[robot, None, :2], axis=-1)
        poi = jnp.argmin(away)
        data = arenas.place(scenario.world.arena, scene.layout, scene.poses)
        readings = sensors.scan(
            key,
            sensor,
            scenario.world.arena,
            data,
            scene.layout,
            scene.light,
            robot,
            sensor.directions,
            scenario.time(state),
        )
        known = decide.known_to(scenario, models, state, index)
        looked_from, sums = state.looked_from, None
        if state.memory is not None:
            looked_from, sums = _remembered(scenario, state.memory, map_of(scenario, state, index))
        inputs = {
            "mean": known.belief.mean,
            "std": known.belief.std,
            "looked_from": looked_from,
            "robot": index,
            "positions": position,
            "present": ~given_up[robot],
            "poses": scene.poses,
            "modality": scenario.modalities,
            "works": (phase != ENDED) & (phase != FAILED),
            "target": robots.target,
        }
        is_due = decide.is_due(scenario, state, index) & ~state.done
        return is_due, {
            "inputs": inputs,
            "action": choose(config.mission, ask(key, policy, models, known), known),
            "seen": state.seen,
            "poi": poi,
            "readings": readings,
            "bearing": viewpoints.bearing(scene.poses[robot], position[poi]),
            "distance": away[poi],
            "sums": sums,
        }

    return observe


def _remembered(
    scenario: Mission, memory: Memory, own: SharedMap | OwnMap
) -> tuple[jax.Array, jax.Array]:
    """Places of the looks in a robot's own map, `[N, M, R L, 2]`, and `[R, N, C]` their sums."""
    assert isinstance(own, OwnMap)
    pois, robots = jnp.arange(own.num_pois), jnp.arange(len(memory.modality))

    def places(poi: jax.Array, modality: jax.Array) -> jax.Array:
        is_of = own.is_known & (memory.poi == poi) & (memory.modality == modality)[:, None]
        return jnp.where(is_of[..., None], memory.place, jnp.inf).reshape(-1, 2)

    def of_robot(robot: jax.Array) -> jax.Array:
        is_own = own.is_known & (robots == robot)[:, None]
        return memory.total(is_own, own.num_pois).log_likelihood

    modalities = jnp.arange(len(scenario.config.modalities))
    looked_from = jax.vmap(jax.vmap(places, (None, 0)), (0, None))(pois, modalities)
    return looked_from, jax.vmap(of_robot)(robots)
