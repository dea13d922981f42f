"""Plays many missions in batches, to compare policies and failures."""

import dataclasses
import functools
import threading
from collections.abc import Callable
from typing import TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int, PyTree

from jaxsense.config import Config
from jaxsense.core.types import Key, pytree
from jaxsense.mission import Case, Mission, MissionState, Record, make_mission, reset
from jaxsense.mission.outcome import measure
from jaxsense.mission.rollout import rollout_batch
from jaxsense.mission.state import Faults, no_faults
from jaxsense.models import Models, init
from jaxsense.run import devices
from jaxsense.run.compilation import Compiler, Program
from jaxsense.run.devices import ALONE, Workers
from jaxsense.run.ledger import CHUNK, Ledger, batch_of, runs_long
from jaxsense.run.monitor import StageError

Measured: TypeAlias = dict[str, PyTree[np.ndarray]]

_STAGE = "mission"  # name of the programs in profiles and caches
_SECOND = "naive"  # whose first mission is recorded as well as that of the first case
_RECORDED = 2  # missions at a time on each device, in its first slots


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
      recording: the first mission of the first case.
      control_steps: total number of control periods, until each mission's end.
      naive: the same mission under naive exploration; None if it was not played, or if there was
        no slot beside the first one.
    """

    metrics: dict[str, Measured]
    recording: Recording
    control_steps: int
    naive: Recording | None = None


def keys_of_episode(key: Key, episode: jax.Array | int) -> tuple[Key, Key]:
    """Keys of an episode's arena and of its events; fold a chunk's index into the second one."""
    arena_key, play_key = jax.random.split(key)
    return jax.random.fold_in(arena_key, episode), jax.random.fold_in(play_key, episode)


@pytree
class _Slots:
    """B missions side by side: `[B]` episodes, chunks that they have played, and states."""

    episode: Int[Array, " B"]
    chunks: Int[Array, " B"]
    states: MissionState


@pytree
class _Found:
    """What the host reads of B missions after a chunk.

    Attributes:
      done: whether they are over.
      steps: control periods so far.
      chunks: played so far.
      is_finite: whether their beliefs are finite.
      has_values: whether no policy returned NaN.
      metrics: see `mission.outcome.measure`.
    """

    done: Bool[Array, " B"]
    steps: Int[Array, " B"]
    chunks: Int[Array, " B"]
    is_finite: Bool[Array, " B"]
    has_values: Bool[Array, " B"]
    metrics: PyTree[Array]


class Player:
    """Plays missions in batches, with programs that are compiled before any model is trained.

    Episode i has the same arena in every case.

    Attributes:
      mission: the mission.
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
          mission: to play.
          compiler: compiles in the background.
          total: number of missions to play, from which the size of a batch follows.
          workers: share the missions. Each thread plays its own, without waiting for the others.
          models: with the shapes of those to play with, for example with a custom fusion; by
            default those of the settings.
        """
        self.mission, self._monitor, self._workers = mission, compiler.monitor, workers
        config, key, mesh = mission.config, jax.random.key(0), workers.mesh
        batch = max(batch_of(config, total, workers), min(total, _RECORDED * workers.number))
        self._share = -(-batch // workers.number)
        self._recorded = min(_RECORDED, self._share)
        self.batch = self._share * workers.number
        # Devices of a mesh take each call together; threads take their own.
        rows, long = self.batch // workers.threads, runs_long(config, total)
        numbers = jax.ShapeDtypeStruct((rows,), jnp.int32)
        faults = jax.tree.map(
            lambda x: jax.ShapeDtypeStruct((rows, *x.shape), x.dtype), no_faults(config)
        )
        begun = key, config, jax.eval_shape(lambda: models or init(key, config))
        options = {"mesh": mesh, "whole": len(begun), "runs_long": long, "wide_vectors": long}
        closed = (*mission.policies,)  # those of a user are not kept
        self._begin, self._go_on = (
            Program(compiler, _STAGE, name, closed) for name in ("begin", "go_on")
        )
        begin = functools.partial(_begin, mission)
        slots = self._begin.compile(begin, *begun, numbers, numbers, faults, **options)
        go_on = functools.partial(_go_on, self._recorded, mission)
        self._go_on.compile(go_on, *begun, slots, slots, numbers, **options)

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
        self._monitor.check_finite(_STAGE, "models", models)
        self.wait()
        config, number, threads = self.mission.config, self._workers.number, self._workers.threads
        total = episodes * len(played)
        case, episode = np.divmod(np.arange(total, dtype=np.int32), episodes)
        of_cases = [
            (np.int32(self.mission.policy(each.policy)), each.faults) for each in played.values()
        ]
        missions = episode, *jax.tree.map(lambda *x: np.stack(x)[case], *of_cases)
        # Missions to record begin in the first slots of the first worker.
        second = [*played].index(_SECOND) if _SECOND in played else 0
        recorded = np.unique([0, second * episodes])[: self._recorded]
        others = np.setdiff1d(np.arange(total), recorded)
        queues = [others[i::number] for i in range(number)]
        queues[0] = np.append(recorded, queues[0])
        lock, done = threading.Lock(), [0]

        def end(some: int) -> None:
            with lock:  # so that no thread reports fewer than another one before it
                done[0] += some
                self._monitor.progress(_STAGE, done[0], total)

        with self._monitor.stopwatch.measure("run_s", _STAGE):
            # Loaded models lie on the host, and every chunk would transfer them again.
            given = key, config, devices.put_everywhere(models, self._workers.mesh)
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
        recording, *naive = results[0][1]
        return Played(metrics, recording, int(found.steps.sum()), *naive)

    def _play(
        self,
        given: tuple[Key, Config, Models],
        missions: tuple[PyTree[np.ndarray], ...],
        recorded: Int[np.ndarray, " K"],
        end: Callable[[int], None],
        queues: list[Int[np.ndarray, " _"]],
    ) -> tuple[list[tuple[np.ndarray, _Found]], list[Recording]]:
        """Plays the missions in the queues of one of the threads.

        Args:
          given: what all calls of the programs take first.
          missions: `[E]` episode, policy and faults of each.
          recorded: missions to record, the first ones of the first queue.
          end: receives the number of missions that have ended.
          queues: of each device of the thread.

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
                reserve = self._begin.run(*given, *_rows(missions, ledger.reserve()))
            slots, taken = reserve if slots is None else slots, ledger.fill()
            slots, found, first = self._go_on.run(*given, slots, reserve, taken)
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
    arenas = mission.world.arena, mission.free_arena
    made = make_mission(config, arenas=arenas)
    return dataclasses.replace(made, policies=mission.policies)


def _begin(
    mission: Mission,
    key: Key,
    config: Config,
    models: Models,
    episode: Int[Array, " B"],
    policies: Int[Array, " B"],
    faults: Faults,
) -> _Slots:
    """Missions before their first step."""
    scenario = _with_numbers(mission, config)

    def begin(episode: jax.Array, policy: jax.Array, faults: Faults) -> MissionState:
        return reset(keys_of_episode(key, episode)[0], scenario, models, policy, faults)

    return _Slots(episode, jnp.zeros_like(episode), jax.vmap(begin)(episode, policies, faults))


def _go_on(
    recorded: int,
    mission: Mission,
    key: Key,
    config: Config,
    models: Models,
    slots: _Slots,
    reserve: _Slots,
    taken: Int[Array, " B"],
) -> tuple[_Slots, _Found, Recording]:
    """A chunk of missions, of which those of the reserve begin where `taken` is not -1."""

    def refill(own: jax.Array, reserved: jax.Array) -> jax.Array:
        is_new = (taken >= 0).reshape(-1, *[1] * (own.ndim - 1))
        return jnp.where(is_new, reserved[jnp.maximum(taken, 0)], own)

    scenario = _with_numbers(mission, config)
    slots = jax.tree.map(refill, slots, reserve)
    keys = jax.vmap(lambda episode: keys_of_episode(key, episode)[1])(slots.episode)
    keys = jax.vmap(jax.random.fold_in)(keys, slots.chunks)
    states, records = rollout_batch(keys, scenario, models, slots.states, CHUNK, recorded)
    slots = _Slots(slots.episode, slots.chunks + 1, states)
    first = jax.tree.map(lambda x: x[:recorded], states)
    return slots, _found(scenario, models, slots), Recording(first, records)


def _found(mission: Mission, models: Models, slots: _Slots) -> _Found:
    """What the host reads of missions."""
    states, belief = slots.states, slots.states.belief
    is_finite = jnp.isfinite(belief.mean) & jnp.isfinite(belief.std)
    return _Found(
        done=states.done,
        steps=states.steps,
        chunks=slots.chunks,
        is_finite=jnp.all(is_finite, axis=(1, 2)),
        has_values=jnp.all(states.robots.target >= 0, axis=1),
        metrics=jax.vmap(lambda state: measure(mission, models, state))(states),
    )
