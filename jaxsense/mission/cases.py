"""Cases to play missions with: policies, and robots that fail."""

import dataclasses

import jax.numpy as jnp

from jaxsense.config import POLICIES, Config
from jaxsense.mission.state import LATENT, Faults, no_faults

FAULT_TIME = 6.0  # s


@dataclasses.dataclass(frozen=True)
class Case:
    """A policy and faults to play missions with.

    Attributes:
      policy: index into `POLICIES`.
      faults: which robots fail, and when.
    """

    policy: int
    faults: Faults


def cases(config: Config) -> dict[str, Case]:
    """Lists the policies, each robot alone, and each robot failing in mid-mission.

    Each of `POLICIES` is a case; in `MODALITY_alone` all other robots stand
    still from the start; in `MODALITY_stops` and `MODALITY_blind` the robot stops or its sensor
    goes blind after 6 s. Cases with faults use the latent policy.
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
