"""Ends and results of missions."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int, PyTree

from jaxsense.config import CONTROL_PERIOD
from jaxsense.core import checks
from jaxsense.dqn import rewards
from jaxsense.mission.state import ENDED, FAILED, Mission, MissionState
from jaxsense.models import Models

REASONS = (
    "running",
    "finished",
    "time limit",
    "unreachable",
    "undetected",
    "exhausted",
    "robot failed",
    "no robot left",
)
"""Reasons why a mission ends, by code. `unreachable`: a robot gave up a PoI that it could not get
to even when it retried; `undetected`: it gave one up after looks that showed nothing;
`exhausted`: it left one at which looks paid, but none from anywhere would have been new;
`robot failed`: the others finished."""


@checks.typed
def reason(state: MissionState) -> Int[Array, ""]:
    """Returns why a mission ended, as an index into `REASONS`."""
    robots = state.robots
    working = robots.phase != FAILED
    ends = [
        (~state.done, "running"),
        (~jnp.any(working), "no robot left"),
        (jnp.any(working & (robots.phase != ENDED)), "time limit"),
        (jnp.any(robots.unreachable), "unreachable"),
        (jnp.any(robots.undetected), "undetected"),
        (jnp.any(robots.exhausted), "exhausted"),
        (jnp.any(~working), "robot failed"),
    ]
    code = jnp.int32(REASONS.index("finished"))
    for applies, name in reversed(ends):
        code = jnp.where(applies, REASONS.index(name), code)
    return code


@checks.typed
def measure(mission: Mission, models: Models, state: MissionState) -> dict[str, PyTree[Array]]:
    """Computes the metrics of a finished mission.

    Args:
      mission: the mission.
      models: trained models.
      state: the last state.

    Returns:
      `classes`: `[N]` int32 true classes.
      `seen`: `[N]` bool, PoIs that were detected; others are neither right nor ambiguous.
      `is_right`: `[N]` bool, whether the map's most likely class is the true one.
      `ambiguous`: `[N]` bool, whether several classes are plausible.
      `confidence`: `[N]` probability of the map's most likely class.
      `nll`: `[N]` negative log-likelihood of the true class, read from the map.
      `told`: for each modality, `[]` share of PoIs whose label the map has right.
      `observations_per_poi`: `[]` looks per PoI.
      `time_s`: `[]` duration, in seconds.
      `collisions`: `[]` int32 control periods with contact.
      `goals`, `goals_reached`: `[]` int32, of all robots.
      `information`: `[]` sum over the map.
      `detections`: `[R]` int32.
      `reason`: `[]` int32, see `reason`.
    """
    config = mission.config
    shown = jax.vmap(models.fusion.most_likely_class)(state.belief)
    plausible = jax.vmap(models.plausible_classes)(state.belief)
    probabilities = jax.vmap(models.fusion.class_probabilities)(state.belief)
    of_truth = jnp.take_along_axis(probabilities, state.classes[:, None], axis=1)[:, 0]
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
        "confidence": jnp.max(probabilities, axis=-1),
        "nll": -jnp.log(of_truth),
        "seen": is_seen,
        "observations_per_poi": jnp.sum(robots.looks) / config.arena.num_pois,
        "time_s": state.steps * CONTROL_PERIOD,
        "collisions": state.contacts,
        "goals": jnp.sum(robots.goals),
        "goals_reached": jnp.sum(robots.reached),
        "information": jnp.sum(rewards.information(state.belief.std)),
        "detections": robots.detections,
        "reason": reason(state),
    }
