"""Cases to play missions with: healthy robots with each policy, and robots that fail."""

import dataclasses
from collections.abc import Iterable, Mapping

import jax.numpy as jnp

from jaxsense.config import Config, ConfigError
from jaxsense.config.scene import require_words
from jaxsense.core import checks
from jaxsense.dqn.policies import POLICIES, Policy, Values, table
from jaxsense.mission.state import Faults, no_faults
from jaxsense.sim import sensors

FAULT_TIME = 6.0  # s
_FAULTS = ("alone", "stops", "blind")
_TAKEN = ("all", "policies", "bytes_per_detection")  # by `evaluate` and by the summary


@dataclasses.dataclass(frozen=True)
class Case:
    """A condition to play missions in: a policy, and faults of robots.

    Attributes:
      policy: index into `Mission.policies`.
      faults: which robots fail, and when.
    """

    policy: int
    faults: Faults


@checks.typed
def require_playable(config: Config, policies: Mapping[str, Values | Policy] | None = None) -> None:
    """Checks that missions can be made and their policies exist, before anything is trained.

    Args:
      config: all settings.
      policies: custom policies by name, in addition to `dqn.POLICIES`.

    Raises:
      ConfigError: if a custom sensor cannot be made, `config.mission.policies` names an unknown
        policy, or a custom policy has a name that is taken or no word.
    """
    sensors.make(config)
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

    Args:
      config: all settings.
      policies: names in the order of `Mission.policies`.

    Raises:
      ConfigError: if the name of a policy is taken or no word.
    """
    healthy, names = no_faults(config), tuple(policies)
    _require_names(names)
    found = {name: Case(policy, healthy) for policy, name in enumerate(names)}
    latent = names.index("latent")
    for r, name in enumerate(config.robot_names if len(config.carried) > 1 else ()):
        own = jnp.arange(len(config.carried)) == r
        alone = Faults(jnp.where(own, jnp.inf, 0.0), healthy.blind_at)
        failing = jnp.where(own, FAULT_TIME, jnp.inf)
        found[f"{name}_alone"] = Case(latent, alone)
        found[f"{name}_stops"] = Case(latent, Faults(failing, healthy.blind_at))
        found[f"{name}_blind"] = Case(latent, Faults(healthy.stops_at, failing))
    return found
