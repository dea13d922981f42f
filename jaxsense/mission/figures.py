"""How a mission has ended and what it has achieved."""

from typing import Any

import jax
import jax.numpy as jnp

from jaxsense.dqn import belief_mdp
from jaxsense.mission.state import ENDED, FAILED, Mission, MissionState
from jaxsense.models import Models
from jaxsense.vae import metrics

REASONS = (
    "running",
    "finished",
    "time limit",
    "unreachable",
    "undetected",
    "robot failed",
    "no robot left",
)
"""How a mission has ended. `unreachable`: a robot gave up a PoI to which it found no way or did not
get; `undetected`: one gave up a PoI after looks that showed nothing; `robot failed`: the others
finished. The index is the reason's code."""


def reason(state: MissionState) -> jax.Array:
    """`[]` int32 index into `REASONS`."""
    robots = state.robots
    working = robots.phase != FAILED
    ends = [
        (~state.is_over, "running"),
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


def figures(mission: Mission, models: Models, state: MissionState) -> dict[str, Any]:
    """What a mission has achieved.

    Returns:
      `classes`, the true ones, `seen`, whether the PoI is in the map, `is_right`, whether the map's
      most likely class is the true one, and `ambiguous`, whether the map leaves more than one open,
      `[N]` each, PoIs that nobody has seen being neither; `told`, for each modality `[]`
      the share of the map that is right in what the sensor can tell; `observations_per_poi`;
      `time_s`; `collisions`, control periods with contact; `goals` and `goals_reached`;
      `information`, the sum over the map; `detections` `[R]`; and `reason`.
    """
    config = mission.config
    nearest = jax.vmap(lambda b: metrics.nearest_class(b, models.class_beliefs.mean))(state.belief)
    plausible = jax.vmap(lambda b: metrics.plausible_classes(b, models.class_beliefs.mean))(
        state.belief
    )
    is_seen = jnp.any(state.seen, axis=-1)
    is_right = is_seen & (nearest == state.classes)
    told = {}
    for modality in config.modalities:
        labels = jnp.array(config.label_of_class(modality))
        told[modality] = jnp.mean(is_seen & (labels[nearest] == labels[state.classes]))
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
        "information": jnp.sum(belief_mdp.information(state.belief.std)),
        "detections": robots.detections,
        "reason": reason(state),
    }
