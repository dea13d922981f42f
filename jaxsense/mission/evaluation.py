"""Many missions, to compare policies and to see what failures do: the summary's `mission` block."""

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxsense import values
from jaxsense.compilation import Compiler, Program
from jaxsense.config import Config
from jaxsense.devices import ALONE, Workers
from jaxsense.mission.figures import REASONS, figures
from jaxsense.mission.rollout import play
from jaxsense.mission.state import (
    LATENT,
    POLICIES,
    Faults,
    Mission,
    MissionState,
    Record,
    no_faults,
    reset,
)
from jaxsense.models import Models, untrained
from jaxsense.types import Key

_CHUNK_TIME = 2.5  # s
_MOST_AT_ONCE = 384
FAULT_TIME = 6.0  # s


@dataclasses.dataclass(frozen=True)
class Case:
    """Something to play missions with.

    Attributes:
      policy: index into `POLICIES`.
      faults: which robots fail, and when.
    """

    policy: int
    faults: Faults


@dataclasses.dataclass(frozen=True)
class Recording:
    """A whole mission.

    Attributes:
      end: the state in which it ended.
      records: `[steps]` of all control periods, and of some after its end that are like the last.
    """

    end: MissionState
    records: Record


def cases(config: Config) -> dict[str, Case]:
    """The policies, each robot alone, and each robot failing in mid-mission.

    `latent`, `naive` and `random` are the policies; `MODALITY_alone` has all other robots stand
    still from the start; in `MODALITY_stops` and `MODALITY_blind` the robot stops or its sensor
    goes blind after 6 s. Failures are played with the latent policy.
    """
    healthy = no_faults(config)
    found = {name: Case(policy, healthy) for policy, name in enumerate(POLICIES)}
    for m, modality in enumerate(config.modalities if len(config.modalities) > 1 else ()):
        own = jnp.arange(len(config.modalities)) == m
        alone = Faults(jnp.where(own, jnp.inf, 0.0), healthy.blind_at)
        failing = jnp.where(own, FAULT_TIME, jnp.inf)
        found[f"{modality}_alone"] = Case(LATENT, alone)
        found[f"{modality}_stops"] = Case(LATENT, Faults(failing, healthy.blind_at))
        found[f"{modality}_blind"] = Case(LATENT, Faults(healthy.stops_at, failing))
    return found


def chunks(config: Config) -> tuple[int, int]:
    """Control periods of a chunk, after which the host looks on, and the most chunks there are."""
    settings = config.mission
    chunk = math.ceil(min(_CHUNK_TIME, settings.time_limit) / settings.control_period)
    return chunk, math.ceil(settings.time_limit / settings.control_period / chunk)


def batch_of(total: int) -> int:
    """How many of all missions to play side by side: fewer than all, as some last long."""
    values.require_number("total", total)
    return min(_MOST_AT_ONCE, -(-total // 3))


def keys_of_episode(key: Key, episode: jax.Array | int) -> tuple[Key, Key]:
    """Keys of an episode's arena, and of what happens in it; fold the number of a chunk into it."""
    arena_key, play_key = jax.random.split(key)
    return jax.random.fold_in(arena_key, episode), jax.random.fold_in(play_key, episode)


class Player:
    """Plays missions in batches, with programs that are compiled once, before there are models.

    Episode i has the same arena in every case, and in every batch.

    Attributes:
      mission: the mission.
      control_steps: control periods of missions played so far, until they were over.
      recording: the first mission of the first case that `play` played last; None before.
    """

    def __init__(self, mission: Mission, compiler: Compiler, batch: int, workers: Workers = ALONE):
        """Compiles for about `batch` missions side by side, which the workers share."""
        batch = -(-batch // workers.number) * workers.number
        self.mission, self._monitor, self._batch = mission, compiler.monitor, batch
        self.control_steps = 0
        self.recording: Recording | None = None
        config, share = mission.config, batch // workers.number
        chunk, _ = chunks(config)

        def begin(key: Key, episode: jax.Array, policies: jax.Array, faults: Faults):
            def begin_one(episode: jax.Array, policy: jax.Array, faults: Faults):
                return reset(keys_of_episode(key, episode)[0], mission, policy, faults)

            return jax.vmap(begin_one)(episode, policies, faults)

        def go_on(
            key: Key, episode: jax.Array, number: jax.Array, models: Models, state: MissionState
        ):
            keys = jax.vmap(lambda episode: keys_of_episode(key, episode)[1])(episode)
            keys = jax.vmap(jax.random.fold_in)(keys, number)
            state, records = play(keys, mission, models, state, chunk, share)
            return state, jax.vmap(lambda s: figures(mission, models, s))(state), records

        key, numbers = jax.random.key(0), jax.ShapeDtypeStruct((batch,), jnp.int32)
        faults = jax.tree.map(
            lambda x: jax.ShapeDtypeStruct((batch, *x.shape), x.dtype), no_faults(config)
        )
        self._begin = Program(compiler, "mission", "begin")
        state = self._begin.compile(
            begin, key, numbers, numbers, faults, workers=workers, whole=(0,)
        )
        models = jax.eval_shape(lambda: untrained(jax.random.key(0), config))
        self._go_on = Program(compiler, "mission", "go_on")
        self._go_on.compile(
            go_on, key, numbers, numbers, models, state, workers=workers, whole=(0, 3)
        )

    def wait(self) -> None:
        """Waits until the programs are compiled."""
        self._begin.wait()
        self._go_on.wait()

    def play(
        self, key: Key, models: Models, played: dict[str, Case], episodes: int
    ) -> dict[str, dict[str, Any]]:
        """Plays every case in the same arenas.

        Args:
          key: random key.
          models: trained networks.
          played: what to play with.
          episodes: how many missions of each case.

        Returns:
          For each case the `[episodes, ...]` figures of `figures.figures`.

        Raises:
          StageError: if the models or the map of a mission are not finite; a policy would take a
            value that is not for the end of its mission.
        """
        self._monitor.check_finite("mission", "models", models)
        total = episodes * len(played)
        row = np.arange(-(-total // self._batch) * self._batch, dtype=np.int32) % total
        case, episode = row // episodes, row % episodes
        policies = np.array([c.policy for c in played.values()], np.int32)[case]
        faults = jax.tree.map(lambda *x: np.stack(x)[case], *[c.faults for c in played.values()])
        inputs = episode, policies, faults

        def begin(first: int) -> MissionState:
            part = jax.tree.map(lambda x: x[first : first + self._batch], inputs)
            return jax.tree.map(np.asarray, self._begin(key, *part))

        begun = [begin(first) for first in range(0, len(row), self._batch)]
        starts = jax.tree.map(lambda *x: np.concatenate(x), *begun)

        # A mission that is over makes room for the next one, so that short ones do not wait.
        state = jax.tree.map(lambda x: x[: self._batch].copy(), starts)
        playing, waiting = np.arange(self._batch), iter(range(self._batch, total))
        chunk, done = np.zeros(self._batch, np.int32), np.zeros(len(row), bool)
        results: Any = None
        first: list[tuple[MissionState, Record]] = []
        while not done[:total].all():
            self._monitor.check_stop()
            state, found, records = self._go_on(key, episode[playing], chunk, models, state)
            state, found, records = jax.tree.map(np.array, (state, found, records))
            at = f"beliefs after {chunk.max() + 1} chunks"
            self._monitor.check_finite("mission", at, state.belief)
            if not done[0]:
                first.append(jax.tree.map(lambda x: x[0].copy(), (state, records)))
            if results is None:
                results = jax.tree.map(lambda x: np.zeros((len(row), *x.shape[1:]), x.dtype), found)
            chunk += 1
            for slot in np.flatnonzero(state.is_over & ~done[playing]).tolist():
                done[playing[slot]] = True
                self.control_steps += int(state.steps[slot])
                _set_row(results, int(playing[slot]), found, slot)
                following = next(waiting, None)
                if following is not None:
                    playing[slot], chunk[slot] = following, 0
                    _set_row(state, slot, starts, following)
            self._monitor.progress("mission", int(done[:total].sum()), total)
        ends, chunks_of_records = zip(*first, strict=True)
        whole = jax.tree.map(lambda *parts: np.concatenate(parts), *chunks_of_records)
        self.recording = Recording(ends[-1], whole)
        joined = jax.tree.map(lambda x: x[:total], results)
        return {
            name: jax.tree.map(lambda x: x[i * episodes : (i + 1) * episodes], joined)  # noqa: B023
            for i, name in enumerate(played)
        }


def _set_row(target: Any, row: int, source: Any, from_row: int) -> None:
    """Copies a row of every array of a tree into another."""

    def copy(target: np.ndarray, source: np.ndarray) -> None:
        target[row] = source[from_row]

    jax.tree.map(copy, target, source)


def summarise(config: Config, name: str, found: dict[str, Any]) -> dict[str, Any]:
    """One case's block of `summary.json`.

    Args:
      config: all settings.
      name: of the case.
      found: `[E, ...]` from `Player.play`.

    Returns:
      Means over the missions, but for `time_s`, which is the median, and `collisions`, the sum.
      For a robot alone also `told`, the accuracy of what its sensor can tell apart, and
      `ambiguous_reported`, how many of the PoIs it cannot tell apart the map shows as ambiguous.
    """
    block: dict[str, Any] = {
        "accuracy": float(found["is_right"].mean()),
        "observations_per_poi": float(found["observations_per_poi"].mean()),
        "time_s": float(np.median(found["time_s"])),
        "collisions": int(found["collisions"].sum()),
        "goals_reached_fraction": _share(found["goals_reached"].sum(), found["goals"].sum()),
        "information": float(found["information"].mean()),
        "episodes": len(found["time_s"]),
        "ended": {
            reason: int(np.sum(found["reason"] == code))
            for code, reason in enumerate(REASONS)
            if np.any(found["reason"] == code)
        },
    }
    modality = name.removesuffix("_alone")
    if modality != name:
        labels = np.array(config.label_of_class(modality))
        shares_label = np.array([np.sum(labels == label) > 1 for label in labels])
        cannot_tell = shares_label[found["classes"]]
        block["told"] = float(found["told"][modality].mean())
        reported = found["ambiguous"][cannot_tell]
        block["ambiguous_reported"] = _share(reported.sum(), reported.size)
    return block


def _share(part: Any, whole: Any) -> float | None:
    """A share; None of nothing."""
    return float(part / whole) if whole else None


def bytes_per_detection(mission: Mission, detections: np.ndarray) -> dict[str, float]:
    """What a detection puts on the network, in bytes.

    Args:
      mission: the mission.
      detections: `[R]` how many of each robot.

    Returns:
      `latent`, the size of an entry of the map, and `raw`, the mean size of the scans that the
      detections were made of; of the sensors' scans if there were none.
    """
    detections = np.maximum(detections, 0 if np.any(detections) else 1)
    scans = np.array([sensor.scan_bytes for sensor in mission.world.sensors])
    entry = 2 * mission.config.jmvae.latent_size * np.dtype(np.float32).itemsize
    return {"latent": float(entry), "raw": float(np.average(scans, weights=detections))}


def summary(
    key: Key, player: Player, models: Models, played: dict[str, Case], episodes: int
) -> dict[str, Any]:
    """Plays missions and gives the summary's block `mission`; see `Player.play` for arguments."""
    found = player.play(key, models, played, episodes)
    config = player.mission.config
    blocks = {name: summarise(config, name, figures) for name, figures in found.items()}
    detections = sum(figures["detections"].sum(axis=0) for figures in found.values())
    size = bytes_per_detection(player.mission, np.asarray(detections))
    return {**blocks, "bytes_per_detection": size}
