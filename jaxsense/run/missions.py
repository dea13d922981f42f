"""Plays many missions in batches, to compare policies and failures."""

import dataclasses
import math
import threading
from typing import TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from jaxsense.config import MISSIONS_AT_ONCE, Config
from jaxsense.core import checks
from jaxsense.core.types import Key
from jaxsense.mission import (
    Case,
    Faults,
    Mission,
    MissionState,
    Record,
    make_mission,
    measure,
    no_faults,
    reset,
    rollout_batch,
)
from jaxsense.models import Models, init
from jaxsense.run.compilation import Compiler, Program
from jaxsense.run.devices import ALONE, Workers
from jaxsense.run.monitor import StageError

_CHUNK_TIME = 2.5  # s
Measured: TypeAlias = dict[str, PyTree[np.ndarray]]


@dataclasses.dataclass(frozen=True)
class Recording:
    """A whole mission.

    Attributes:
      end: its last state.
      records: `[steps]` records of all control periods; after the end, the last one repeats.
    """

    end: MissionState
    records: Record


@dataclasses.dataclass(frozen=True)
class Played:
    """The results of many missions.

    Attributes:
      metrics: `[episodes, ...]` metrics of each case; see `mission.measure`.
      recording: the first mission of the first case.
      control_steps: total number of control periods, until each mission's end.
    """

    metrics: dict[str, Measured]
    recording: Recording
    control_steps: int


def chunk_of(config: Config) -> int:
    """Control periods between two reports. Traced settings must not enter: it is a size."""
    return math.ceil(_CHUNK_TIME / config.mission.control_period)


def batch_of(total: int) -> int:
    """How many missions to play side by side: fewer than all, since some last long.

    Args:
      total: number of missions.

    Raises:
      ValueError: if it is not a number greater than 0.
    """
    checks.require_number("total", total)
    return min(MISSIONS_AT_ONCE, -(-total // 3))


def keys_of_episode(key: Key, episode: jax.Array | int) -> tuple[Key, Key]:
    """Keys of an episode's arena and of its events.

    Args:
      key: of all missions.
      episode: its index.

    Returns:
      The two keys; fold a chunk's index into the second one.
    """
    arena_key, play_key = jax.random.split(key)
    return jax.random.fold_in(arena_key, episode), jax.random.fold_in(play_key, episode)


class Player:
    """Plays missions in batches, with programs that are compiled before any model is trained.

    Episode i has the same arena in every case.

    Attributes:
      mission: the mission.
    """

    def __init__(self, mission: Mission, compiler: Compiler, batch: int, workers: Workers = ALONE):
        """Starts to compile the programs.

        Args:
          mission: to play.
          compiler: compiles in the background.
          batch: number of missions side by side, rounded up to a multiple of the workers.
          workers: share the missions.
        """
        batch = -(-batch // workers.number) * workers.number
        self.mission, self._monitor, self._batch = mission, compiler.monitor, batch
        config, share = mission.config, batch // workers.number
        parts = 1 if workers.mesh is None else workers.number  # a thread sees only its own rows
        chunk = chunk_of(config)
        self._lock = threading.Lock()

        def with_numbers(config: Config) -> Mission:
            return make_mission(
                config, mission.policies, arenas=(mission.world.arena, mission.free_arena)
            )

        def begin(
            key: Key,
            config: Config,
            models: Models,
            episode: jax.Array,
            policies: jax.Array,
            faults: Faults,
        ):
            scenario = with_numbers(config)

            def begin_one(episode: jax.Array, policy: jax.Array, faults: Faults):
                return reset(keys_of_episode(key, episode)[0], scenario, models, policy, faults)

            return jax.vmap(begin_one)(episode, policies, faults)

        def go_on(
            key: Key,
            config: Config,
            models: Models,
            episode: jax.Array,
            number: jax.Array,
            state: MissionState,
        ):
            scenario = with_numbers(config)
            keys = jax.vmap(lambda episode: keys_of_episode(key, episode)[1])(episode)
            keys = jax.vmap(jax.random.fold_in)(keys, number)
            state, records = rollout_batch(keys, scenario, models, state, chunk, share, parts)
            return state, jax.vmap(lambda s: measure(scenario, models, s))(state), records

        key, numbers = jax.random.key(0), jax.ShapeDtypeStruct((batch,), jnp.int32)
        faults = jax.tree.map(
            lambda x: jax.ShapeDtypeStruct((batch, *x.shape), x.dtype), no_faults(config)
        )
        models = jax.eval_shape(lambda: init(jax.random.key(0), config))
        self._begin = Program(compiler, "mission", "begin")
        state = self._begin.compile(
            begin, key, config, models, numbers, numbers, faults, workers=workers, whole=(0, 1, 2)
        )
        self._go_on = Program(compiler, "mission", "go_on")
        self._go_on.compile(
            go_on, key, config, models, numbers, numbers, state, workers=workers, whole=(0, 1, 2)
        )

    def wait(self) -> None:
        """Waits until the programs are compiled."""
        self._begin.wait()
        self._go_on.wait()

    def play(self, key: Key, models: Models, played: dict[str, Case], episodes: int) -> Played:
        """Plays every case in the same arenas.

        Args:
          key: random key.
          models: trained networks.
          played: the cases.
          episodes: missions of each case.

        Raises:
          StageError: if the models or the beliefs of a mission are not finite, which policies would
            take for the end of the mission, or if a policy's values are NaN.
          Stopped: if the run was asked to stop.
        """
        with self._lock:  # one call uses the whole machine
            return self._play(key, models, played, episodes)

    def _starts(
        self, key: Key, models: Models, played: dict[str, Case], episodes: int
    ) -> tuple[np.ndarray, MissionState]:
        """Episodes and first states of all missions; the first ones repeat to fill a batch."""
        total = episodes * len(played)
        row = np.arange(-(-total // self._batch) * self._batch, dtype=np.int32) % total
        case, episode = row // episodes, row % episodes
        policies = np.array([c.policy for c in played.values()], np.int32)[case]
        faults = jax.tree.map(lambda *x: np.stack(x)[case], *[c.faults for c in played.values()])

        def begin(first: int) -> MissionState:
            rows = slice(first, first + self._batch)
            some = jax.tree.map(lambda x: x[rows], faults)
            config = self.mission.config
            state = self._begin(key, config, models, episode[rows], policies[rows], some)
            return jax.tree.map(np.asarray, state)

        begun = [begin(first) for first in range(0, len(row), self._batch)]
        return episode, jax.tree.map(lambda *x: np.concatenate(x), *begun)

    def _play(self, key: Key, models: Models, played: dict[str, Case], episodes: int) -> Played:
        """See `play`."""
        self._monitor.check_finite("mission", "models", models)
        config, total = self.mission.config, episodes * len(played)
        episode, starts = self._starts(key, models, played, episodes)

        # The next mission takes the slot of one that is done, so that short ones do not wait.
        state = jax.tree.map(lambda x: x[: self._batch].copy(), starts)
        playing, waiting = np.arange(self._batch), iter(range(self._batch, total))
        chunk, done = np.zeros(self._batch, np.int32), np.zeros(len(episode), bool)
        results: Measured | None = None
        ends, recorded = list[MissionState](), list[Record]()
        control_steps = 0
        while not done[:total].all():
            self._monitor.check_stop()
            state, found, records = self._go_on(key, config, models, episode[playing], chunk, state)
            state, found, records = jax.tree.map(np.array, (state, found, records))
            at = f"beliefs after {chunk.max() + 1} chunks"
            self._monitor.check_finite("mission", at, state.belief)
            _check_choices(self.mission, state)
            if not done[0]:
                ends.append(jax.tree.map(lambda x: x[0].copy(), state))
                recorded.append(jax.tree.map(lambda x: x[0].copy(), records))
            if results is None:
                results = jax.tree.map(
                    lambda x: np.zeros((len(done), *x.shape[1:]), x.dtype), found
                )
            chunk += 1
            for slot in np.flatnonzero(state.done & ~done[playing]).tolist():
                done[playing[slot]] = True
                control_steps += int(state.steps[slot])
                _set_row(results, int(playing[slot]), found, slot)
                following = next(waiting, None)
                if following is not None:
                    playing[slot], chunk[slot] = following, 0
                    _set_row(state, slot, starts, following)
            self._monitor.progress("mission", int(done[:total].sum()), total)
        whole = jax.tree.map(lambda *parts: np.concatenate(parts), *recorded)
        metrics = {
            name: jax.tree.map(lambda x: x[i * episodes : (i + 1) * episodes], results)  # noqa: B023
            for i, name in enumerate(played)
        }
        return Played(metrics, Recording(ends[-1], whole), control_steps)


def _check_choices(mission: Mission, states: MissionState) -> None:
    """Raises `StageError` if values of a policy were NaN in one of several missions."""
    for policy in states.policy[np.any(states.robots.target < 0, axis=-1)]:
        raise StageError(f"mission: values of policy {[*mission.policies][policy]} are not finite")


def _set_row(target: PyTree, row: int, source: PyTree, from_row: int) -> None:
    """Copies one row of each array of a tree into another tree."""

    def copy(target: np.ndarray, source: np.ndarray) -> None:
        target[row] = source[from_row]

    jax.tree.map(copy, target, source)
