"""Plays many missions in batches, to compare policies and failures."""

import dataclasses
import threading
from collections.abc import Callable
from typing import TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int, PyTree

from jaxsense.config import Config
from jaxsense.core.types import Key, pytree
from jaxsense.mission import (
    Case,
    Faults,
    Mission,
    MissionState,
    make_mission,
    measure,
    no_faults,
    reset,
    rollout_batch,
)
from jaxsense.models import Models, init
from jaxsense.run import devices, films
from jaxsense.run.batches import CHUNK
from jaxsense.run.compilation import Compiler, Program
from jaxsense.run.devices import ALONE, Workers
from jaxsense.run.films import Films, Recording
from jaxsense.run.ledger import Ledger
from jaxsense.run.monitor import StageError

Measured: TypeAlias = dict[str, PyTree[np.ndarray]]

_STAGE, _BEGIN = "mission", "begin"  # names of the programs in profiles and caches
_SECOND = "naive"  # whose first mission is recorded as well as that of the first case


@dataclasses.dataclass(frozen=True)
class Played:
    """The results of many missions.

    Attributes:
      metrics: `[episodes, ...]` metrics of each case; see `mission.measure`.
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
    """Keys of an episode's arena and of its events.

    Args:
      key: of all missions.
      episode: its index.

    Returns:
      The two keys; fold a chunk's index into the second one.
    """
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
    """What the host reads of B missions after a chunk, `[B]` each.

    Attributes:
      done: whether they are over.
      steps: control periods so far.
      chunks: played so far.
      is_finite: whether their beliefs are finite.
      has_values: whether no policy returned NaN.
      metrics: see `mission.measure`.
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
    """

    def __init__(
        self,
        mission: Mission,
        compiler: Compiler,
        batch: int,
        workers: Workers = ALONE,
        runs_long: bool = False,
        models: Models | None = None,
    ):
        """Starts to compile the programs.

        Args:
          mission: to play.
          compiler: compiles in the background.
          batch: number of missions side by side, rounded up to a multiple of the workers.
          workers: share the missions. Each thread plays its own, without waiting for the others.
          runs_long: see `devices.compiler_options`.
          models: with the shapes of those to play with, for example with a custom fusion; by
            default those of the settings.
        """
        self.mission, self._monitor, self._workers = mission, compiler.monitor, workers
        config, self._share = mission.config, -(-batch // workers.number)
        # Devices of a mesh take each call together; threads take their own.
        together = Workers(mesh=workers.mesh)
        recorded = min(films.AT_A_TIME, self._share)
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
        ) -> _Slots:
            scenario = with_numbers(config)

            def begin_one(episode: jax.Array, policy: jax.Array, faults: Faults):
                return reset(keys_of_episode(key, episode)[0], scenario, models, policy, faults)

            states = jax.vmap(begin_one)(episode, policies, faults)
            return _Slots(episode, jnp.zeros_like(episode), states)

        def go_on(
            key: Key,
            config: Config,
            models: Models,
            slots: _Slots,
            reserve: _Slots,
            taken: jax.Array,
        ) -> tuple[_Slots, _Found, Recording]:
            scenario = with_numbers(config)
            slots = _refilled(slots, reserve, taken)
            keys = jax.vmap(lambda episode: keys_of_episode(key, episode)[1])(slots.episode)
            keys = jax.vmap(jax.random.fold_in)(keys, slots.chunks)
            states, records = rollout_batch(keys, scenario, models, slots.states, CHUNK, recorded)
            slots = _Slots(slots.episode, slots.chunks + 1, states)
            first = jax.tree.map(lambda x: x[:recorded], states)
            return slots, _found(scenario, models, slots), Recording(first, records)

        number = self._share * together.number
        numbers = jax.ShapeDtypeStruct((number,), jnp.int32)
        faults = jax.tree.map(
            lambda x: jax.ShapeDtypeStruct((number, *x.shape), x.dtype), no_faults(config)
        )
        key = jax.random.key(0)
        shapes = jax.eval_shape(lambda: models or init(key, config))
        begun = key, config, shapes, numbers, numbers, faults
        whole = (0, 1, 2)
        self._begin = Program(compiler, _STAGE, _BEGIN)
        slots = self._begin.compile(
            begin,
            *begun,
            workers=together,
            whole=whole,
            runs_long=runs_long,
            wide_vectors=runs_long,
        )
        self._go_on = Program(compiler, _STAGE, "go_on")
        _, self._found, _ = self._go_on.compile(
            go_on,
            key,
            config,
            shapes,
            slots,
            slots,
            numbers,
            workers=together,
            whole=whole,
            runs_long=runs_long,
            wide_vectors=runs_long,
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
            self._monitor.check_finite("mission", "models", models)
            self.wait()
            with self._monitor.stopwatch.measure("run_s", "mission"):
                # Loaded models lie on the host, and every chunk would transfer them again.
                models = devices.put_everywhere(models, self._workers.mesh)
                call = _Call(key, models, played, episodes, self._found.metrics)
                devices.side_by_side(
                    lambda lane: self._play(call, lane),
                    self._workers.threads,
                    stop=call.failed.set,
                )
                return call.result()

    def _play(self, call: "_Call", lane: int) -> None:
        """Plays the missions of one of the threads."""
        config, parts = self.mission.config, self._workers.number // self._workers.threads
        missions = call.films.order(call.total, self._workers.number)
        lanes = [missions[lane * parts + p :: self._workers.number] for p in range(parts)]
        ledger = Ledger(lanes, self._share)
        slots: _Slots | None = None
        reserve: _Slots | None = None
        while not ledger.is_over and not call.failed.is_set():
            try:
                self._monitor.check_stop()
                if ledger.needs_reserve:
                    begun = call.begins(ledger.reserve())
                    reserve = self._begin.run(call.key, config, call.models, *begun)
                slots = reserve if slots is None else slots
                taken = ledger.fill()
                slots, found, first = self._go_on.run(
                    call.key, config, call.models, slots, reserve, taken
                )
                self._check(call, ledger, found := devices.fetched(found))
                playing = ledger.playing.copy()
                if lane == 0:
                    call.films.record(playing, first)
                ended = ledger.end(found.done)
                call.end(playing[ended], jax.tree.map(lambda x: x[ended], found), self._report)  # noqa: B023
            except BaseException:
                call.failed.set()
                raise

    def _report(self, done: int, total: int) -> None:
        """Reports how many missions of a call are done."""
        self._monitor.progress("mission", done, total)

    def _check(self, call: "_Call", ledger: Ledger, found: _Found) -> None:
        """Raises `StageError` if beliefs or values of a policy were not finite in a mission."""
        plays = ledger.playing >= 0
        for slot in np.flatnonzero(plays & ~found.is_finite):
            at = f"beliefs after {found.chunks[slot]} chunks"
            raise StageError(f"mission: {at} are not finite")
        for slot in np.flatnonzero(plays & ~found.has_values):
            policy = [*self.mission.policies][call.policies[ledger.playing[slot]]]
            raise StageError(f"mission: values of policy {policy} are not finite")


class _Call:
    """The missions of one call of `Player.play`, case by case, and their results so far."""

    def __init__(
        self,
        key: Key,
        models: Models,
        played: dict[str, Case],
        episodes: int,
        metrics: PyTree[jax.ShapeDtypeStruct],
    ):
        self.key, self.models = key, models
        self.total = episodes * len(played)
        self.failed = threading.Event()
        self.num_done = 0
        self._cases, self._episodes, self._control_steps = [*played], episodes, 0
        of_case = np.arange(self.total, dtype=np.int32) // episodes
        self.policies = np.array([c.policy for c in played.values()], np.int32)[of_case]
        faults = [c.faults for c in played.values()]
        self._faults: Faults = jax.tree.map(lambda *x: np.stack(x)[of_case], *faults)
        self._metrics = jax.tree.map(
            lambda x: np.zeros((self.total, *x.shape[1:]), x.dtype), metrics
        )
        second = [*played].index(_SECOND) * episodes if _SECOND in [*played][1:] else None
        self.films = Films(second)
        self._lock = threading.Lock()

    def begins(self, missions: Int[np.ndarray, " B"]) -> tuple[np.ndarray, np.ndarray, Faults]:
        """Episodes, policies and faults of missions."""
        faults = jax.tree.map(lambda x: x[missions], self._faults)
        return missions % self._episodes, self.policies[missions], faults

    def end(
        self, missions: Int[np.ndarray, " E"], found: _Found, report: Callable[[int, int], None]
    ) -> None:
        """Keeps the results of missions that are done, and reports their number and that of all."""

        def put(rows: np.ndarray, new: np.ndarray) -> None:
            rows[missions] = new

        jax.tree.map(put, self._metrics, found.metrics)
        with self._lock:
            self.num_done += len(missions)
            self._control_steps += int(found.steps.sum())
            # Here, so that no lane reports fewer than another one before it.
            report(self.num_done, self.total)

    def result(self) -> Played:
        """The results of all missions, which must be done."""
        number = self._episodes
        metrics = {
            name: jax.tree.map(lambda x: x[i * number : (i + 1) * number], self._metrics)  # noqa: B023
            for i, name in enumerate(self._cases)
        }
        recording, *others = self.films.recordings()
        return Played(metrics, recording, self._control_steps, *others)


def _refilled(slots: _Slots, reserve: _Slots, taken: jax.Array) -> _Slots:
    """Slots with missions of the reserve where `taken` is not -1."""

    def refill(own: jax.Array, reserved: jax.Array) -> jax.Array:
        is_new = (taken >= 0).reshape(-1, *[1] * (own.ndim - 1))
        return jnp.where(is_new, reserved[jnp.maximum(taken, 0)], own)

    return jax.tree.map(refill, slots, reserve)


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
