"""Ends and results of missions."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxsense.config import Config
from jaxsense.dqn import rewards
from jaxsense.mission.state import ENDED, FAILED, Mission, MissionState
from jaxsense.models import Models
from jaxsense.vae import latent

REASONS = (
    "running",
    "finished",
    "time limit",
    "unreachable",
    "undetected",
    "robot failed",
    "no robot left",
)
"""Ends of a mission. `unreachable`: a robot gave up a PoI without getting there, and did not take
it back before it ended; `undetected`: it gave up one after looks that showed nothing; `robot
failed`: the others finished. The index is the reason's code."""


def reason(state: MissionState) -> jax.Array:
    """Reason of a mission's end, `[]` int32 index into `REASONS`."""
    robots = state.robots
    working = robots.phase != FAILED
    ends = [
        (~state.done, "running"),
        (~jnp.any(working), "no robot left"),
        (jnp.any(working & (robots.phase != ENDED)), "time limit"),
        (jnp.any(robots.unreachable), "unreachable"),
        (jnp.any(robots.undetected), "undetected"),
        (jnp.any(~working), "robot failed"),
    ]
    code = jnp.int32(REASONS.index("finished"))
    for applies, name in reversed(ends):
        code = jnp.where(applies, REASONS.index(name), code)
    return code


def measure(mission: Mission, models: Models, state: MissionState) -> dict[str, Any]:
    """Measures the results of a mission.

    Returns:
      `[N]` each, `classes`, the true ones, `seen`, whether the PoI is in the map, `is_right`,
      whether the map's most likely class is true, and `ambiguous`, whether the map leaves more than
      one open (unseen PoIs are neither); `told`, for each modality `[]` the share of PoIs whose
      label the map has right; `observations_per_poi`; `time_s`; `collisions`, control periods with
      contact; `goals` and `goals_reached`; `information`, the sum over the map; `detections` `[R]`;
      and `reason`.
    """
    config = mission.config
    means = models.fusion.classes.mean
    shown = jax.vmap(models.fusion.most_likely_class)(state.belief)
    plausible = jax.vmap(lambda b: latent.plausible_classes(b, means))(state.belief)
    is_seen = jnp.any(state.seen, axis=-1)
    is_right = is_seen & (shown == state.classes)
    told = {}
    for modality in config.modalities:
        labels = jnp.array(config.label_of_class(modality))
        told[modality] = jnp.mean(is_seen & (labels[shown] == labels[state.classes]))
    robots = state.robots
    return {
        "classes": state.classes,
        "is_right": is_right,
        "told": told,
        "ambiguous": is_seen & (jnp.sum(plausible, axis=-1) > 1),
        "seen": is_seen,
        "observations_per_poi": jnp.sum(robots.looks) / config.arena.num_pois,
        "time_s": state.steps * config.mission.control_period,
        "collisions": state.contacts,
        "goals": jnp.sum(robots.goals),
        "goals_reached": jnp.sum(robots.reached),
        "information": jnp.sum(rewards.information(state.belief.std)),
        "detections": robots.detections,
        "reason": reason(state),
    }


def summarise(config: Config, name: str, found: dict[str, Any]) -> dict[str, Any]:
    """Summarises one case for `summary.json`.

    Args:
      config: all settings.
      name: of the case.
      found: `[E, ...]` from `Player.play`.

    Returns:
      Means over the missions, except the median of `time_s` and the sum of `collisions`. For a
      robot alone also `told`, the accuracy of its sensor's labels, and `ambiguous_reported`, the
      share of the PoIs it cannot distinguish that the map shows as ambiguous.
    """
    block: dict[str, Any] = {
        "accuracy": float(found["is_right"].mean()),
        "observations_per_poi": float(found["observations_per_poi"].mean()),
        "time_s": float(np.median(found["time_s"])),
        "mean_time_s": float(found["time_s"].mean()),
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
    robot = name.removesuffix("_alone")
    if robot != name:
        modality = config.carried[config.robot_names.index(robot)]
        labels = np.array(config.label_of_class(modality))
        shares_label = np.array([np.sum(labels == label) > 1 for label in labels])
        cannot_tell = shares_label[found["classes"]]
        block["told"] = float(found["told"][modality].mean())
        reported = found["ambiguous"][cannot_tell]
        block["ambiguous_reported"] = _share(reported.sum(), reported.size)
    return block


def _share(part: Any, whole: Any) -> float | None:
    """Share of a whole; None if that is 0."""
    return float(part / whole) if whole else None


def bytes_per_detection(mission: Mission, detections: np.ndarray) -> dict[str, float]:
    """Network traffic of a detection, in bytes.

    Args:
      mission: the mission.
      detections: `[R]` number of each robot's detections.

    Returns:
      `latent`, the size of an entry of the map; `features` and `raw`, the mean sizes of the
      detections' features and scans; without detections the mean over the sensors.
    """
    detections = np.maximum(detections, 0 if np.any(detections) else 1)
    config, size = mission.config, np.dtype(np.float32).itemsize
    sensors = [mission.world.sensors[m] for m in config.modality_of_robot]
    scans = np.array([sensor.scan_bytes for sensor in sensors])
    features = np.array([size * len(config.labels(name)) for name in config.carried])
    return {
        "latent": float(2 * size * config.jmvae.latent_size),
        "features": float(np.average(features, weights=detections)),
        "raw": float(np.average(scans, weights=detections)),
    }
