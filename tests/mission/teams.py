"""Settings and models for missions that need no training."""

from dataclasses import replace

import jax
import jax.numpy as jnp

from jaxsense import dqn, mission
from jaxsense.config import PRESETS
from jaxsense.vae import readout

# Untrained detectors are never sure; what they say is of no importance here. Robots follow values.
_FOLLOWING = replace(PRESETS["smoke"].mission, least_confidence=0.0, auctions=False)
CONFIG = replace(PRESETS["smoke"], mission=_FOLLOWING)
POLICIES = tuple(dqn.POLICIES)
LATENT, NAIVE = POLICIES.index("latent"), POLICIES.index("naive")


def with_config(team, config):
    """The same mission with other numbers, which may be traced."""
    arenas = team.world.arena, team.free_arena
    return mission.make_mission(config, team.policies, arenas=arenas)


def with_class_beliefs(models, classes):
    """The same models with other joint posteriors of the classes."""
    fusion = replace(models.fusion, classes=classes, readout=readout.make(classes))
    return replace(models, fusion=fusion)


def alone(function):
    """A function of missions side by side as a function of a single one."""

    def of_one(*args):
        batch = jax.tree.map(lambda x: jnp.asarray(x)[None], args)
        return jax.tree.map(lambda x: x[0], function(*batch))

    return of_one


def with_values(models, *values):
    """Models whose Q-networks give the same values [N + 1] for every map, one for each robot."""

    def constant(network, value):
        zero = jax.tree.map(jnp.zeros_like, network)
        last = max(zero["params"], key=lambda name: int(name.split("_")[1]))
        zero["params"][last]["bias"] = jnp.array(value, jnp.float32)
        return zero

    networks = tuple(constant(n, v) for n, v in zip(models.q_networks, values, strict=True))
    return replace(models, q_networks=networks)
