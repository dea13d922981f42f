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

_STAGE, _BEGIN = "mission", "begin"  # names of the programs in profiles and caches
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
      naive: the same mission under naive exploration; None if it was not played, or if the first
        worker did not begin it together with the first one.
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
        config, key = mission.config, jax.random.key(0)
        batch = max(batch_of(config, total, workers), min(total, _RECORDED * workers.number))
        self._share = -(-batch // workers.number)
        self.batch = self._share * workers.number
        # Devices of a mesh take each call together; threads take their own.
        together = Workers(mesh=workers.mesh)
        rows, long = self._share * together.number, runs_long(config, total)
        numbers = jax.ShapeDtypeStruct((rows,), jnp.int32)
        faults = jax.tree.map(
            lambda x: jax.ShapeDtypeStruct((rows, *x.shape), x.dtype), no_faults(config)
        )
        begun = key, config, jax.eval_shape(lambda: models or init(key, config))

        def compiled(name: str, function: Callable[..., PyTree], *args: PyTree):
            program = Program(compiler, _STAGE, name)
            function = functools.partial(function, mission)
            options = {"runs_long": long, "wide_vectors": long}
            return program, program.compile(
                function, *begun, *args, workers=together, whole=(0, 1, 2), **options
            )

        self._begin, slots = compiled(_BEGIN, _begin, numbers, numbers, faults)
        go_on = functools.partial(_go_on, min(_RECORDED, self._share))
        self._go_on, (_, self._found, _) = compiled("go_on", go_on, slots, slots, numbers)

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
        with self._monitor.stopwatch.measure("run_s", _STAGE):
            # Loaded models lie on the host, and every chunk would transfer them again.
            models = devices.put_everywhere(models, self._workers.mesh)
            call = _Call(key, models, played, episodes, self._found.metrics)
            play = functools.partial(self._play, call)
            devices.side_by_side(play, self._workers.threads, stop=call.stopped.set)
            return call.result()

    def _play(self, call: "_Call", lane: int) -> None:
        """Plays the missions of one of the threads."""
        config, parts = self.mission.config, self._workers.number // self._workers.threads
        missions = call.order(self._workers.number)
        ledger = Ledger(
            [missions[lane * parts + p :: self._workers.number] for p in range(parts)], self._share
        )
        slots: _Slots | None = None
        reserve: _Slots | None = None
        while not ledger.is_over and not call.stopped.is_set():
            self._monitor.check_stop()
            if ledger.needs_reserve:
                begun = call.begins(ledger.reserve())
                reserve = self._begin.run(call.key, config, call.models, *begun)
            slots, taken = reserve if slots is None else slots, ledger.fill()
            slots, found, first = self._go_on.run(
                call.key, config, call.models, slots, reserve, taken
            )
            found, playing = devices.fetched(found), ledger.playing.copy()
            self._check(call, playing, found)
            if lane == 0:
                call.record(playing, first)
            ended = ledger.end(found.done)
            call.end(playing[ended], _rows(found, ended), self._monitor.progress)

    def _check(self, call: "_Call", playing: Int[np.ndarray, " B"], found: _Found) -> None:
        """Raises `StageError` if beliefs or values of a policy were not finite in a mission."""
        for slot in np.flatnonzero((playing >= 0) & ~(found.is_finite & found.has_values)):
            what = f"beliefs after {found.chunks[slot]} chunks"
            if found.is_finite[slot]:
                what = f"values of policy {[*self.mission.policies][call.policies[playing[slot]]]}"
            raise StageError(f"{_STAGE}: {what} are not finite")


class _Call:
    """The missions of one call of `Player.play`, case by case, and what was found of them."""

    def __init__(
        self,
        key: Key,
        models: Models,
        played: dict[str, Case],
        episodes: int,
        metrics: PyTree[jax.ShapeDtypeStruct],
    ):
        self.key, self.models, self.stopped = key, models, threading.Event()
        self._cases, self._episodes, self._total = [*played], episodes, episodes * len(played)
        self._done = self._control_steps = 0
        case = np.arange(self._total) // episodes
        self.policies = np.array([each.policy for each in played.values()], np.int32)[case]
        faults = [each.faults for each in played.values()]
        self._faults: Faults = jax.tree.map(lambda *x: np.stack(x)[case], *faults)
        self._metrics = jax.tree.map(
            lambda x: np.zeros((self._total, *x.shape[1:]), x.dtype), metrics
        )
        second = [*played].index(_SECOND) if _SECOND in played else 0
        self._wanted = (0, second * episodes) if second else (0,)
        self._recorded = [list[Recording]() for _ in self._wanted]
        self._lock = threading.Lock()

    def order(self, stride: int) -> Int[np.ndarray, " E"]:
        """All missions; in a list of every `stride`-th one, those to record come first."""
        missions = np.arange(self._total, dtype=np.int32)
        for i, mission in enumerate(self._wanted):
            if i * stride < self._total:
                missions[[i * stride, mission]] = missions[[mission, i * stride]]
        return missions

    def begins(self, missions: Int[np.ndarray, " B"]) -> tuple[np.ndarray, np.ndarray, Faults]:
        """Episodes, policies and faults of missions."""
        return missions % self._episodes, self.policies[missions], _rows(self._faults, missions)

    def record(self, playing: Int[np.ndarray, " B"], first: Recording) -> None:
        """Keeps a chunk of missions to record, of which `[K]` are in a device's first slots."""
        wanted = enumerate(self._wanted[: len(first.end.done)])
        if due := [i for i, mission in wanted if playing[i] == mission]:
            fetched = devices.fetched(first)
            for i in due:
                self._recorded[i].append(_rows(fetched, i))

    def end(
        self,
        missions: Int[np.ndarray, " E"],
        found: _Found,
        report: Callable[[str, int, int], None],
    ) -> None:
        """Keeps the results of missions that are done, and reports their number and that of all."""

        def put(rows: np.ndarray, new: np.ndarray) -> None:
            rows[missions] = new

        jax.tree.map(put, self._metrics, found.metrics)
        with self._lock:
            self._done += len(missions)
            self._control_steps += int(found.steps.sum())
            # Here, so that no lane reports fewer than another one before it.
            report(_STAGE, self._done, self._total)

    def result(self) -> Played:
        """The results of all missions, which must be done."""
        rows = np.arange(self._total).reshape(-1, self._episodes)
        metrics = {
            name: _rows(self._metrics, each) for name, each in zip(self._cases, rows, strict=True)
        }
        recording, *others = (_whole(chunks) for chunks in self._recorded if chunks)
        return Played(metrics, recording, self._control_steps, *others)


def _rows(values: PyTree, rows: int | np.ndarray) -> PyTree[np.ndarray]:
    """Copies some rows of arrays."""
    return jax.tree.map(lambda x: np.array(x[rows]), values)


def _whole(chunks: list[Recording]) -> Recording:
    """A recording from its chunks."""
    records = [each.records for each in chunks]
    return Recording(chunks[-1].end, jax.tree.map(lambda *x: np.concatenate(x), *records))


def _with_numbers(mission: Mission, config: Config) -> Mission:
    """The mission with traced settings."""
    arenas = mission.world.arena, mission.free_arena
    return make_mission(config, mission.policies, arenas=arenas)


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
