"""Detectors and a JMVAE that were really trained, in as little time as will do."""

import dataclasses
import functools

import jax

from benchmarks.maps import Examiner, Task
from jaxsense import PRESETS, init, learn
from jaxsense.config import DetectorConfig, DqnConfig, JmvaeConfig

_CONFIG = dataclasses.replace(
    PRESETS["default"],
    detector=DetectorConfig(num_scans=24576, num_held_out=3 * 4096, steps=1500, batch=256),
    jmvae=JmvaeConfig(samples_per_class=4096, steps=2000),
    dqn=DqnConfig(
        observe="bank",
        epochs=400,
        chunk=20,
        updates=8,
        batch=256,
        replay_capacity=65536,
        epsilon_decay=0.98,
        target_period=10,
    ),
)
_QUICK = dataclasses.replace(
    PRESETS["smoke"],
    detector=DetectorConfig(num_scans=384, num_held_out=3 * 64, steps=20, batch=32),
    jmvae=JmvaeConfig(restarts=1, samples_per_class=64, steps=20, batch=32),
)


@functools.cache
def trained_task(quick: bool) -> tuple[Task, Examiner]:
    """The map MDP on detections of trained detectors, once for all rows, and its examination.

    The examination has detections of its own.
    """
    config = _QUICK if quick else _CONFIG
    train = jax.jit(lambda key: learn(key, config, until="look_values").outputs)
    outputs = train(jax.random.key(6))
    trained = dataclasses.replace(
        init(jax.random.key(6), config),
        fusion=outputs["fusion"],
        jmvae=outputs["best_jmvae"],
        look_values=outputs["look_values"],
    )
    bank, held_out = outputs["detections"].bank, outputs["detections"].held_out
    examiner = Examiner(Task(config, trained, held_out), 32 if quick else 4096)
    return Task(config, trained, bank), examiner
