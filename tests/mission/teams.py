"""Settings and models for missions that need no training."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from jaxsense import dqn, mission, sim
from jaxsense.config import PRESETS
from jaxsense.core.types import pytree
from jaxsense.mission import begin, decide
from jaxsense.mission.state import no_faults
from jaxsense.sim.light import Light
from jaxsense.vae import detectors, readout

# Untrained detectors are never sure; what they say is of no importance here.
_UNSURE = replace(PRESETS["smoke"].mission, least_confidence=0.0)
CONFIG = replace(PRESETS["smoke"], mission=_UNSURE)
POLICIES = tuple(dqn.POLICIES)
LATENT, NAIVE = POLICIES.index("latent"), POLICIES.index("naive")
# The robot is 1.0, 0.8 and 1.6 m from PoIs 0, 1 and 2.
POSITIONS = [[1.0, 0.0], [0.0, 0.8], [-1.0, -1.25]]
POSES = [[0.0, 0.0, 0.0], [1.2, 1.2, 0.0]]
# Of which PoI 0 is 0.8 m ahead of a robot at the origin.
AHEAD = [[0.8, 0.0], [-1.0, 1.0], [-1.0, -1.0]]


def with_config(team, config):
    """The same mission with other numbers, which may be traced."""
    return mission.make_mission(config, team.policies)


def starting(team, models):
    """Starts missions in chosen arenas: PoIs, robots' poses, classes, policy and faults."""

    @jax.jit
    def start(positions, poses, classes, policy, faults):
        yaw = jnp.zeros(len(classes))
        layout = sim.make_layout(team.config.arena, positions, yaw, classes)
        light = Light(jnp.array([0.6, 0.0, 0.8]), jnp.float32(0.5), jnp.float32(0.5))
        scene = sim.Scene(layout, light, poses)
        paths, no_error = mission.roadmap.build(team.config, layout), jnp.zeros_like(poses)
        return begin.start(team, models, scene, classes, policy, faults, paths, no_error)

    def make(positions, poses, classes=(0, 1, 2), policy=NAIVE, faults=None):
        positions, poses = (np.array(x, np.float32) for x in (positions, poses))
        faults = no_faults(team.config) if faults is None else faults
        return start(positions, poses, np.array(classes), np.int32(policy), faults)

    return make


def with_class_beliefs(models, classes):
    """The same models with other joint posteriors of the classes."""
    fusion = replace(models.fusion, classes=classes, readout=readout.make(classes))
    return replace(models, fusion=fusion)


@pytree
class Seeing:
    """A detector whose odds are read from the middle of a window, without noise worth mention.

    A camera finds what is coloured there, and a LiDAR what is there at most 0.24 m nearer than the
    centre of the PoI.
    """

    detector: detectors.Classifier
    sharpness: np.float32 = np.float32(1.0)

    @property
    def num_labels(self):
        return self.detector.num_labels

    @property
    def window_size(self):
        return self.detector.window_size

    @property
    def threshold(self):
        return jnp.float32(0.0)

    def logits(self, window, distance):
        labels = self.detector.logits(window, distance)[:-1]
        if self.detector.measures_distance:
            odds = 0.12 - jnp.abs(jnp.mean(window[60:68] - distance) + 0.12)
        else:
            red, green, blue = jnp.mean(window.reshape(80, 3)[37:43], axis=0)
            odds = jax.nn.relu(red - blue) + jax.nn.relu(green - blue) - 0.1
        return jnp.append(labels, self.sharpness * odds)


def with_eyes(models):
    """Models of a camera and a LiDAR that find PoIs without a training."""
    return replace(models, detectors=tuple(map(Seeing, models.detectors)))


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


def decide_alone(key, mission, models, state, robot):
    """The state after a decision of one robot in one mission, if one is due."""
    batch = jax.tree.map(lambda x: jnp.asarray(x)[None], state)
    chosen = decide.choices(key[None], mission, models, batch, robot, batch.policy[0])[0]
    after = decide.set_out(mission, models, state, robot, chosen)
    due = decide.is_due(mission, state, robot)
    return jax.tree.map(lambda x, y: jnp.where(due, x, y), after, state)
