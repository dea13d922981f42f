"""Cases to play missions with, and their ends and results."""

import dataclasses
from collections.abc import Iterable, Mapping

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int, PyTree

from jaxsense.config import Config, ConfigError
from jaxsense.config.mission import CONTROL_PERIOD
from jaxsense.config.scene import require_words
from jaxsense.core import checks
from jaxsense.dqn import rewards
from jaxsense.dqn.policies import POLICIES, Values, table
from jaxsense.mission.roadmap import require_known_places
from jaxsense.mission.state import ENDED, FAILED, Faults, Mission, MissionState, no_faults
from jaxsense.models import Models
from jaxsense.sim import sensors

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


FAULT_TIME = 6.0  # s
_FAULTS = ("alone", "stops", "blind")
_TAKEN = ("all", "policies")  # by `evaluate`


@dataclasses.dataclass(frozen=True)
class Case:
    """A condition to play missions in: a policy, and faults of robots."""

    policy: str
    faults: Faults


@checks.typed
def require_playable(config: Config, policies: Mapping[str, Values] | None = None) -> None:
    """Checks that missions can be made and their policies exist, before anything is trained."""
    sensors.make(config)
    require_known_places(config)
    known = table(policies)
    _require_names(known)
    if not set(config.mission.policies) <= set(known):
        reason = f"must be among {', '.join(known)}"
        raise ConfigError("mission.policies", config.mission.policies, reason)


def _require_names(policies: Iterable[str]) -> None:
    """Raises `ConfigError` if a policy's name is no word, or names a fault or something else."""
    names = dict.fromkeys(policies)
    require_words(names, "policies")
    for name in filter(is_fault, names):
        raise ConfigError("policies", name, f"must not end in _{', _'.join(_FAULTS)}")
    for name in _TAKEN:
        if name in names:
            raise ConfigError("policies", name, f"must not be {', '.join(_TAKEN)}")


def is_fault(case: str) -> bool:
    """Tells from the name of a case whether a robot is alone, stops or goes blind in it."""
    checks.require_type("case", case, str, "as from cases")
    return case.endswith(tuple(f"_{fault}" for fault in _FAULTS))


@checks.typed
def cases(config: Config, policies: Iterable[str] = POLICIES) -> dict[str, Case]:
    """Lists a case for every policy, for each robot alone, and for each robot that fails.

    Each policy is a case. In `ROBOT_alone` all other robots stand still from the start; in
    `ROBOT_stops` and `ROBOT_blind` the robot stops or its sensor goes blind after 6 s. Robots are
    named as in `Config.robot_names`. Cases with faults use the latent policy.
    """
    healthy, names, number = no_faults(config), tuple(policies), len(config.carried)
    _require_names(names)
    found = {name: Case(name, healthy) for name in names}
    for r, name in enumerate(config.robot_names if number > 1 else ()):
        own = jnp.arange(number) == r
        alone, failing = jnp.where(own, jnp.inf, 0.0), jnp.where(own, FAULT_TIME, jnp.inf)
        found[f"{name}_alone"] = Case("latent", Faults(alone, healthy.blind_at))
        found[f"{name}_stops"] = Case("latent", Faults(failing, healthy.blind_at))
        found[f"{name}_blind"] = Case("latent", Faults(healthy.stops_at, failing))
    return found


@checks.typed
def reason(state: MissionState) -> Int[Array, ""]:
    """Returns why a mission ended, as an index into `REASONS`."""
    robots = state.robots
    working = robots.phase != FAILED
    applies = {
        "running": ~state.done,
        "no robot left": ~jnp.any(working),
        "time limit": jnp.any(working & (robots.phase != ENDED)),
        "unreachable": jnp.any(robots.unreachable),
        "undetected": jnp.any(robots.undetected),
        "exhausted": jnp.any(robots.exhausted),
        "robot failed": jnp.any(~working),
        "finished": jnp.bool_(True),
    }
    codes = jnp.array([REASONS.index(name) for name in applies])
    return codes[jnp.argmax(jnp.stack([*applies.values()]))]


@checks.typed
def measure(mission: Mission, models: Models, state: MissionState) -> dict[str, PyTree[Array]]:
    """Computes the metrics of a finished mission.

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
      `reason`: `[]` int32, see `reason`.
    """
    config = mission.config
    plausible = jax.vmap(models.plausible_classes)(state.belief)
    probabilities = jax.vmap(models.fusion.class_probabilities)(state.belief)
    shown = jnp.argmax(probabilities, axis=1)
    of_truth = jnp.take_along_axis(probabilities, state.classes[:, None], axis=1)[:, 0]
    is_seen = jnp.any(state.seen, axis=-1)
    is_right = is_seen & (shown == state.classes)

    def told(modality: str) -> Array:
        labels = jnp.array(config.label_of_class(modality))
        return jnp.mean(is_seen & (labels[shown] == labels[state.classes]))

    robots = state.robots
    return {
        "classes": state.classes,
        "is_right": is_right,
        "told": {modality: told(modality) for modality in config.modalities},
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
        "reason": reason(state),
    }
