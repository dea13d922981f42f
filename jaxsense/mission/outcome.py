"""Ends and results of missions."""

from typing import Any

import jax
import jax.numpy as jnp

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
