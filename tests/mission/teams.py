"""Settings and models for missions that need no training."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from jaxsense import dqn, mission
from jaxsense.config import PRESETS
from jaxsense.vae import readout

# Untrained detectors are never sure; what they say is of no importance here. Robots follow values.
_FOLLOWING = replace(PRESETS["smoke"].mission, least_confidence=0.0, auctions=False)
CONFIG = replace(PRESETS["smoke"], mission=_FOLLOWING)
POLICIES = tuple(dqn.POLICIES)
LATENT, NAIVE = POLICIES.index("latent"), POLICIES.index("naive")
# The robot is 1.0, 0.8 and 1.6 m from PoIs 0, 1 and 2.
POSITIONS = [[1.0, 0.0], [0.0, 0.8], [-1.0, -1.25]]
POSES = [[0.0, 0.0, 0.0], [1.2, 1.2, 0.0]]


def with_config(team, config):
    """The same mission with other numbers, which may be traced."""
    arenas = team.world.arena, team.free_arena
    return mission.make_mission(config, team.policies, arenas=arenas)


def with_class_beliefs(models, classes):
    """The same models with other joint posteriors of the classes."""
    fusion = replace(models.fusion, classes=classes, readout=readout.make(classes))
    return replace(models, fusion=fusion)


def with_gates(models):
    """Models whose gates read the middle of a window, without noise worth mention.

    The camera's passes what is coloured there, and the LiDAR's what is there at most 0.24 m nearer
    than the centre of the PoI.
    """
    camera, lidar = models.detectors
    weights = np.zeros((242, 32), np.float32)
    colours = weights[: 3 * 80].reshape(80, 3, 32)
    colours[37:43, 0, 0] = colours[37:43, 1, 1] = 1 / 6  # red, green
    colours[37:43, 2, :2] = -1 / 6  # less blue
    of_camera = _gate(camera, weights, 0.0, np.array([1.0, 1.0]), -0.1)
    weights = np.zeros((130, 32), np.float32)
    weights[60:68, 0] = 0.2 / 8  # the range less the distance, of which it reads a fifth of a metre
    weights[:, 1] = -weights[:, 0]
    of_lidar = _gate(lidar, weights, np.array([0.12, -0.12]), np.array([-1.0, -1.0]), 0.12)
    return replace(models, detectors=(of_camera, of_lidar))


def _gate(detector, first, bias, second, last):
    """A detector whose gate adds up two units."""
    params = jax.tree.map(np.zeros_like, detector.gate.params)
    layers = params["params"]
    # It reads distances as they are, and all else standardised.
    scale = 1.0 if detector.gate.measures_distance else detector.scale
    layers["Dense_0"]["kernel"][:] = first * scale
    layers["Dense_0"]["bias"][:2] = bias
    layers["Dense_1"]["kernel"][[0, 1], [0, 1]] = 1.0
    layers["Dense_2"]["kernel"][:2, 0] = second
    layers["Dense_2"]["bias"][0] = last
    gate = replace(detector.gate, params=params, threshold=np.float32(0.0))
    return replace(detector, gate=gate)


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
