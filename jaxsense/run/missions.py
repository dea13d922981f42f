"""Plays many missions in batches, to compare policies and failures."""

import dataclasses
import functools
import math
import threading
from collections.abc import Callable, Sequence
from typing import TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int, PyTree

from jaxsense.config import Config
from jaxsense.config.mission import CONTROL_PERIOD
from jaxsense.core.types import Key, pytree
from jaxsense.mission import Case, Mission, MissionState, Record, make_mission, reset
from jaxsense.mission.outcome import measure
from jaxsense.mission.rollout import rollout_batch
from jaxsense.mission.state import Faults, no_faults
from jaxsense.models import Models, init
from jaxsense.run import devices
from jaxsense.run.compilation import Compiler, Program
from jaxsense.run.devices import ALONE, Workers
from jaxsense.run.monitor import StageError, is_finite
from jaxsense.summary.compare import Measured

_STAGE = "mission"  # name of the programs in profiles and caches
_SECOND = "naive"  # whose first mission is recorded as well as that of the first case
_RECORDED = 2  # missions at a time on each device, in its first slots
CHUNK = math.ceil(2.5 / CONTROL_PERIOD)
"""Control periods between two reports."""
# Missions side by side: what the caches of a thread of a CPU hold, and on each accelerator.
_MOST_OF_CPU, _MOST_OF_ACCELERATOR = 192, 32768
# Of an accelerator's memory for each, most of it for the physics, and for paths between two PoIs.
_BYTES_EACH, _BYTES_OF_PATHS = 2**20, 2**10
# A control step of so many missions takes an accelerator twice as long as that of a few. With T
# missions, B of which play at once, the time is about (T / B + 1) * (1 + B / this): B squared is
# this times T at its minimum.
_AS_LONG_AS_NONE = 8192
_MANY_POIS = 2**14  # of all missions that take longer to play than faster programs to compile


def batch_of(total: int, num_pois: int, workers: Workers = ALONE) -> int:
    """Number of missions side by side: the more there are, the more pay on an accelerator.

    Some missions last long, so that a CPU is at work to the end with a third of them.
    """
    memory = devices.memory()
    if memory is None:
        return min(_MOST_OF_CPU * workers.number, -(-total // 3))
    pays = math.isqrt(_AS_LONG_AS_NONE * total * workers.number)
    fit = memory // (_BYTES_EACH + _BYTES_OF_PATHS * num_pois**2)
    return min(total, pays, min(_MOST_OF_ACCELERATOR, fit) * workers.number)


@pytree
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
      metrics: `[episodes, ...]` metrics of each case; see `mission.outcome.measure`.
      recordings: the first mission of the first case and, if there was a slot for it, the same
        one under naive exploration.
      control_steps: total number of control periods, until each mission's end.
    """

    metrics: dict[str, Measured]
    recordings: dict[str, Recording]
    control_steps: int


def keys_of_episode(key: Key, episode: jax.Array | int) -> tuple[Key, Key]:
    """Keys of an episode's arena and of its events; fold a chunk's index into the second one."""
    arena_key, play_key = jax.random.split(key)
    return jax.random.fold_in(arena_key, episode), jax.random.fold_in(play_key, episode)


_Given: TypeAlias = tuple[Key, Config, Models]
"""What all calls of the programs take first."""


@pytree
class _Slots:
    """B missions side by side: `[B]` episodes, chunks that they have played, and states."""

    episode: Int[Array, " B"]
    chunks: Int[Array, " B"]
    states: MissionState


@pytree
class _Found:
    """What the host reads of B missions after a chunk; policies have values unless one is NaN."""

    done: Bool[Array, " B"]
    steps: Int[Array, " B"]
    chunks: Int[Array, " B"]
    is_finite: Bool[Array, " B"]
    has_values: Bool[Array, " B"]
    metrics: PyTree[Array]


class Ledger:
    """Assigns missions to the P x S slots of a batch, whose P parts lie on devices of their own.

    A mission that is done makes room for the next one of its part, from a reserve of P x S missions
    that have begun.
    """

    def __init__(self, waiting: Sequence[Int[np.ndarray, " _"]], slots: int):
        """Lets the missions of each of the P parts wait for its S slots."""
        self._waiting = [missions.tolist() for missions in waiting]
        self._playing = np.full((len(waiting), slots), -1, np.int32)  # idle slots
        self._reserve = self._playing.copy()  # missions that are still there

    @property
    def is_over(self) -> bool:
        """Whether all missions are done."""
        return not any(self._waiting) and max(self._playing.max(), self._reserve.max()) < 0

    @property
    def needs_reserve(self) -> bool:
        """Whether missions wait in a part whose reserve is used up."""
        parts = zip(self._waiting, self._reserve, strict=True)
        return any(waiting and reserve.max() < 0 for waiting, reserve in parts)

    def reserve(self) -> Int[np.ndarray, " B"]:
        """Begins a new reserve, one mission a slot. Where a part has fewer, one fills the rest."""
        for waiting, reserve in zip(self._waiting, self._reserve, strict=True):
            first = [*reserve[reserve >= 0].tolist(), *waiting]
            some, waiting[:] = first[: len(reserve)], first[len(reserve) :]
            reserve[:] = some + [-1] * (len(reserve) - len(some))
        return np.maximum(self._reserve, 0).reshape(-1)

    def fill(self) -> Int[np.ndarray, " B"]:
        """Gives idle slots to missions of the reserve.

        Returns:
          Index that each slot takes of the reserve of its part; -1 if it keeps its own.
        """
        taken = np.full_like(self._playing, -1)
        for part, (playing, reserve) in enumerate(zip(self._playing, self._reserve, strict=True)):
            idle, ready = np.flatnonzero(playing < 0), np.flatnonzero(reserve >= 0)
            number = min(len(idle), len(ready))
            idle, ready = idle[:number], ready[:number]
            taken[part, idle], playing[idle], reserve[ready] = ready, reserve[ready], -1
        return taken.reshape(-1)

    @property
    def playing(self) -> Int[np.ndarray, " B"]:
        """Mission in each slot; -1 in idle ones."""
        return self._playing.reshape(-1)

    def end(self, done: Bool[np.ndarray, " B"]) -> Int[np.ndarray, " _"]:
        """Ends missions in slots that are `done`; returns the slots that are idle from now on."""
        slots = np.flatnonzero(done & (self.playing >= 0))
        self.playing[slots] = -1
        return slots


class Player:
    """Plays missions in batches, with programs that are compiled before any model is trained.

    Episode i has the same arena in every case.

    Attributes:
      batch: number of missions side by side.
    """

    def __init__(
        self,
        mission: Mission,
        compiler: Compiler,
        total: int,
        workers: Workers = ALONE,
        models: Models | None = None,
    ):
        """Starts to compile the programs.

        Args:
          total: number of missions to play, from which the size of a batch follows.
          workers: share the missions. Each thread plays its own, without waiting for the others.
          models: with the shapes of those to play with, for example with a custom fusion; by
            default those of the settings.
        """
        self.mission, self._monitor, self._workers = mission, compiler.monitor, workers
        config, key, mesh = mission.config, jax.random.key(0), workers.mesh
        batch = max(
            batch_of(total, config.arena.num_pois, workers), min(total, _RECORDED * workers.number)
        )
        self._share = -(-batch // workers.number)
        self._recorded = min(_RECORDED, self._share)
        self.batch = self._share * workers.number
        # Devices of a mesh take each call together; threads take their own.
        rows, long = self.batch // workers.threads, total * config.arena.num_pois >= _MANY_POIS
        numbers = jax.ShapeDtypeStruct((rows,), jnp.int32)
        faults = jax.tree.map(
            lambda x: jax.ShapeDtypeStruct((rows, *x.shape), x.dtype), no_faults(config)
        )
        given = key, config, jax.eval_shape(lambda: models or init(key, config))
        options = {"mesh": mesh, "whole": 1, "runs_long": long, "wide_vectors": long}
        closed = (*mission.policies,)  # those of a user are not kept
        self._begin, self._go_on = (
            Program(compiler, _STAGE, name, closed) for name in ("begin", "go_on")
        )
        begin = functools.partial(_begin, mission)
        slots = self._begin.compile(begin, given, numbers, numbers, faults, **options)
        go_on = functools.partial(_go_on, self._recorded, mission)
        self._go_on.compile(go_on, given, slots, slots, numbers, **options)

    def wait(self) -> None:
        """Waits until the programs are compiled."""
        self._begin.wait()
        self._go_on.wait()

    def play(self, key: Key, models: Models, played: dict[str, Case], episodes: int) -> Played:
        """Plays `episodes` missions of every case, in the same arenas.

        Raises:
          StageError: if the models or the beliefs of a mission are not finite, which policies would
            take for the end of the mission, or if a policy's values are NaN.
          Stopped: if the run was asked to stop.
        """
        if not is_finite(models):
            raise StageError(f"{_STAGE}: models are not finite")
        self.wait()
        config, number, threads = self.mission.config, self._workers.number, self._workers.threads
        total = episodes * len(played)
        case, episode = np.divmod(np.arange(total, dtype=np.int32), episodes)
        of_cases = [
            (np.int32(self.mission.policy(each.policy)), each.faults) for each in played.values()
        ]
        missions = episode, *jax.tree.map(lambda *x: np.stack(x)[case], *of_cases)
        # Missions to record begin in the first slots of the first worker.
        names = [*played]
        shown = [name for name in names if name in (names[0], _SECOND)][: self._recorded]
        recorded = np.array([names.index(name) * episodes for name in shown])
        others = np.setdiff1d(np.arange(total), recorded)
        queues = [others[i::number] for i in range(number)]
        queues[0] = np.append(recorded, queues[0])
        lock, done = threading.Lock(), [0]

        def end(some: int) -> None:
            with lock:  # so that no thread reports fewer than another one before it
                done[0] += some
                self._monitor.progress(_STAGE, done[0], total)

        with self._monitor.measure("run_s", _STAGE):
            # Loaded models lie on the host, and every chunk would transfer them again.
            if (mesh := self._workers.mesh) is None:
                models = jax.device_put(models)
            else:
                models = devices.put(models, devices.places(mesh, 1, whole=1)[0])
            given = key, config, models
            play = functools.partial(self._play, given, missions, recorded, end)
            lanes = [queues[i::threads] for i in range(threads)]
            results = devices.side_by_side(play, lanes, threads, fail=self._monitor.fail)
        ended = [each for of_lane, _ in results for each in of_lane]
        numbers, found = jax.tree.map(lambda *x: np.concatenate(x), *ended)
        found = _rows(found, np.argsort(numbers))
        metrics = {
            name: _rows(found.metrics, slice(i * episodes, (i + 1) * episodes))
            for i, name in enumerate(played)
        }
        recordings = dict(zip(shown, results[0][1], strict=True))
        return Played(metrics, recordings, int(found.steps.sum()))

    def _play(
        self,
        given: _Given,
        missions: tuple[PyTree[np.ndarray], ...],
        recorded: Int[np.ndarray, " K"],
        end: Callable[[int], None],
        queues: list[Int[np.ndarray, " _"]],
    ) -> tuple[list[tuple[np.ndarray, _Found]], list[Recording]]:
        """Plays the missions in the queues of a thread, one for each of its devices.

        Args:
          missions: `[E]` episode, policy and faults of each.
          recorded: missions to record, the first ones of the first queue.
          end: receives the number of missions that have ended.

        Returns:
          Missions that have ended at the same time with what was found of them, and recordings.
        """
        ledger, ended = Ledger(queues, self._share), list[tuple[np.ndarray, _Found]]()
        slots: _Slots | None = None
        reserve: _Slots | None = None
        chunks = [list[Recording]() for each in recorded if each in queues[0]]
        while not ledger.is_over:
            self._monitor.check_stop()
            if ledger.needs_reserve:
                reserve = self._begin.run(given, *_rows(missions, ledger.reserve()))
            slots, taken = reserve if slots is None else slots, ledger.fill()
            slots, found, first = self._go_on.run(given, slots, reserve, taken)
            found, playing = devices.fetched(found), ledger.playing.copy()
            self._check(playing, missions[1], found)
            if due := [i for i, chunk in enumerate(chunks) if playing[i] == recorded[i]]:
                fetched = devices.fetched(first)
                for i in due:
                    chunks[i].append(_rows(fetched, i))
            over = ledger.end(found.done)
            ended.append((playing[over], _rows(found, over)))
            end(len(over))
        return ended, [*map(_whole, chunks)]

    def _check(
        self, playing: Int[np.ndarray, " B"], policies: Int[np.ndarray, " E"], found: _Found
    ) -> None:
        """Raises `StageError` if beliefs or values of a policy were not finite in a mission."""
        for slot in np.flatnonzero((playing >= 0) & ~(found.is_finite & found.has_values)):
            what = f"beliefs after {found.chunks[slot]} chunks"
            if found.is_finite[slot]:
                what = f"values of policy {[*self.mission.policies][policies[playing[slot]]]}"
            raise StageError(f"{_STAGE}: {what} are not finite")


def _rows(values: PyTree, rows: int | slice | np.ndarray) -> PyTree[np.ndarray]:
    """Copies some rows of arrays."""
    return jax.tree.map(lambda x: np.array(x[rows]), values)


def _whole(chunks: list[Recording]) -> Recording:
    """A recording from its chunks."""
    records = [each.records for each in chunks]
    return Recording(chunks[-1].end, jax.tree.map(lambda *x: np.concatenate(x), *records))


def _with_numbers(mission: Mission, config: Config) -> Mission:
    """The mission with traced settings."""
    return dataclasses.replace(make_mission(config), policies=mission.policies)


def _begin(
    mission: Mission,
    given: _Given,
    episode: Int[Array, " B"],
    policies: Int[Array, " B"],
    faults: Faults,
) -> _Slots:
    """Missions before their first step."""
    key, config, models = given
    scenario = _with_numbers(mission, config)

    def begin(episode: jax.Array, policy: jax.Array, faults: Faults) -> MissionState:
        return reset(keys_of_episode(key, episode)[0], scenario, models, policy, faults)

    return _Slots(episode, jnp.zeros_like(episode), jax.vmap(begin)(episode, policies, faults))


def _go_on(
    recorded: int,
    mission: Mission,
    given: _Given,
    slots: _Slots,
    reserve: _Slots,
    taken: Int[Array, " B"],
) -> tuple[_Slots, _Found, Recording]:
    """A chunk of missions, of which those of the reserve begin where `taken` is not -1."""

    def refill(own: jax.Array, reserved: jax.Array) -> jax.Array:
        is_new = (taken >= 0).reshape(-1, *[1] * (own.ndim - 1))
        return jnp.where(is_new, reserved[jnp.maximum(taken, 0)], own)

    key, config, models = given
    scenario = _with_numbers(mission, config)
    slots = jax.tree.map(refill, slots, reserve)
    keys = jax.vmap(lambda episode: keys_of_episode(key, episode)[1])(slots.episode)
    keys = jax.vmap(jax.random.fold_in)(keys, slots.chunks)
    states, records = rollout_batch(keys, scenario, models, slots.states, CHUNK, recorded)
    slots = _Slots(slots.episode, slots.chunks + 1, states)
    first = jax.tree.map(lambda x: x[:recorded], states)
    is_finite = jnp.isfinite(states.belief.mean) & jnp.isfinite(states.belief.std)
    found = _Found(
        done=states.done,
        steps=states.steps,
        chunks=slots.chunks,
        is_finite=jnp.all(is_finite, axis=(1, 2)),
        has_values=jnp.all(states.robots.target >= 0, axis=1),
        metrics=jax.vmap(lambda state: measure(scenario, models, state))(states),
    )
    return slots, found, Recording(first, records)
