"""What a mission in an unknown place has found."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree

from jaxsense.exploration import slots as objects
from jaxsense.exploration.state import ExplorationState
from jaxsense.models import Models

CUTOFF = 0.3
"""Distance at which an object on the map is none of the true ones, in metres."""


def measure(models: Models, state: ExplorationState) -> dict[str, PyTree[Array]]:
    """Computes the metrics of one mission.

    Returns:
      `gospa`: see `slots.Gospa`, with p = 1.
      `off`: `[N]` metres between each PoI and its slot, NaN for one that is not found.
      `existence`: `[S]` probabilities, NaN in unused slots.
      `is_object`: `[S]` whether a PoI is within `CUTOFF` of the slot, and no better slot is.
      `present`: number of PoIs.
      `found`: number of PoIs that the map shows within `CUTOFF`.
      `false`: number of objects on the map that are none.
      `right`: number of PoIs found and looked at whose most likely class is the true one.
      `confidence`: sum of the probabilities of the most likely classes of those looked at.
      `overflow`: candidates that found no free slot.
      `time_s`: duration, in seconds.
      `looks`: number of all robots, with those that show nothing.
      `collisions`: control periods with contact.
    """
    slots, layout, is_found = state.slots, state.scene.layout, objects.found(state.slots)
    result = objects.gospa(slots.position, is_found, layout.position, layout.present, CUTOFF)
    is_there = result.slot < len(is_found)
    probabilities = jax.vmap(models.fusion.class_probabilities)(slots.belief)
    shown = probabilities.at[result.slot].get(mode="clip")
    apart = jnp.linalg.norm(slots.position[:, None] - layout.position[None], axis=-1)
    off = apart.at[result.slot, jnp.arange(len(is_there))].get(mode="fill", fill_value=jnp.nan)
    is_own = result.slot[None] == jnp.arange(len(is_found))[:, None]
    is_near = (apart < CUTOFF) & layout.present[None]
    is_seen = jnp.any(slots.times_seen > 0, axis=1).at[result.slot].get(mode="clip")
    is_right = is_there & is_seen & (jnp.argmax(shown, axis=1) == state.classes)
    return {
        "gospa": result,
        "off": off,
        "existence": jnp.where(slots.is_used, objects.probability(slots), jnp.nan),
        "is_object": jnp.any(is_near & (is_own | ~is_there[None]), axis=1),
        "present": jnp.sum(layout.present),
        "found": jnp.sum(is_there),
        "false": jnp.sum(is_found) - jnp.sum(is_there),
        "right": jnp.sum(is_right),
        "confidence": jnp.sum(jnp.where(is_there & is_seen, jnp.max(shown, axis=1), 0.0)),
        "overflow": slots.overflow,
        "time_s": state.time,
        "looks": jnp.sum(state.robots.looks),
        "collisions": state.contacts,
    }
