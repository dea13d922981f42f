"""The smallest training that has every stage."""

import dataclasses
from types import SimpleNamespace

import jax
import jax.numpy as jnp

from jaxsense import training
from jaxsense.config import PRESETS, DetectorConfig, JmvaeConfig
from jaxsense.config.mission import MissionConfig
from jaxsense.training.stage import is_finite, scan

SMOKE, KEY = PRESETS["smoke"], jax.random.key(7)
# Learning is chaotic, and two programs round differently: a few steps.
TINY = dataclasses.replace(
    SMOKE,
    detector=DetectorConfig(hidden=(8,), num_scans=96, num_held_out=48, steps=41, batch=16),
    jmvae=JmvaeConfig(hidden=(8,), restarts=2, samples_per_class=32, steps=41, batch=16),
    dqn=dataclasses.replace(
        SMOKE.dqn, hidden=(8,), num_envs=8, epochs=4, updates=2, batch=16, replay_capacity=64,
    ),
    mission=MissionConfig(episodes=1, time_limit=0.5),
)  # fmt: skip


def given_problem(config, detector, shown, labels, nothing):
    """In place of `detectors.problem`: what a detector is fitted to."""
    looks = {"shown": shown, "labels": labels, "nothing": nothing}
    return SimpleNamespace(steps=config.steps, learning_rate=config.learning_rate, **looks)


def sources_of(config):
    """For each stage the names of those whose outputs are its inputs, by argument."""
    found = {}

    def drive(stage, **inputs):
        found[stage.name] = inputs
        return stage.name

    training.stages.train(drive, config)
    return found


def inputs_of(name, config, outputs):
    """Inputs of a stage, from the outputs of all."""
    sources = sources_of(config)[name]
    return jax.tree.map(lambda x: outputs[x] if isinstance(x, str) else x, sources)


def learn_by_stages(key, config, until):
    """As `learn`, but each stage in a program of its own: one for all takes XLA twice as long."""
    outputs, finite = {}, []
    with_check = lambda output: (output, is_finite(output))  # noqa: E731

    def drive(stage, **inputs):
        if until in outputs:
            return None
        output, okay = jax.jit(lambda x: with_check(scan(key, config, stage, x)[0]))(inputs)
        outputs[stage.name] = output
        finite.append(okay)
        return output

    training.stages.train(drive, config)
    return training.stages.Learned(outputs, {}, jnp.stack(finite).all())


def stage_of(name, config=TINY):
    return next(stage for stage in training.stages.stages(config) if stage.name == name)
