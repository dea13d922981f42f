"""The smallest training that has every stage."""

import dataclasses

import jax
import jax.numpy as jnp

from jaxsense import training
from jaxsense.config import PRESETS, DetectorConfig, JmvaeConfig, MissionConfig
from jaxsense.training.stage import Stage

SMOKE, KEY = PRESETS["smoke"], jax.random.key(7)
# Learning is chaotic, and two programs round differently: a few steps.
TINY = dataclasses.replace(
    SMOKE,
    detector=DetectorConfig(hidden=(8,), num_scans=96, num_held_out=48, steps=41, batch=16),
    jmvae=JmvaeConfig(hidden=(8,), restarts=2, samples_per_class=32, steps=41, batch=16),
    dqn=dataclasses.replace(
        SMOKE.dqn, hidden=(8,), num_envs=8, epochs=4, chunk=2, updates=2, batch=16,
        replay_capacity=64, num_starts=8,
    ),
    mission=MissionConfig(episodes=1, time_limit=0.5),
)  # fmt: skip


def learn_by_stages(key, config, until):
    """As `learn`, but each stage in a program of its own: one for all takes XLA twice as long."""
    outputs, is_finite = training.stage.Outputs(), []
    for stage in training.stages.stages(config):

        def run(taken, stage=stage):
            given = [Stage(name, lambda key, config, x=x: x) for name, x in taken.items()]
            found = training.stage.compose(key, config, [*given, stage])
            return found.outputs[stage.name], found.is_finite

        outputs[stage.name], finite = jax.jit(run)({name: outputs[name] for name in stage.sources})
        is_finite.append(finite)
        if stage.name == until:
            break
    return training.stage.Learned(outputs, {}, jnp.stack(is_finite).all())


def stage_of(name, config=TINY):
    return next(stage for stage in training.stages.stages(config) if stage.name == name)
