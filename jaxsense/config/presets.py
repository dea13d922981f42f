"""Presets: settings to start a run from."""

from jaxsense.config.learning import (
    DetectorConfig,
    DqnConfig,
    EvaluationConfig,
    JmvaeConfig,
    MdpConfig,
)
from jaxsense.config.mission import MissionConfig
from jaxsense.config.whole import Config

_PAPER = Config(
    jmvae=JmvaeConfig(
        alpha=1.0,
        beta=0.1,
        initial_beta=1.0,
        restarts=1,
        reconstruction_weights=(4.5, 4.5),
    ),
    mdp=MdpConfig(min_increase=0.01, partly_seen_starts=True),
    dqn=DqnConfig(
        observe="bank",
        discount=0.95,
        epochs=2000,
        updates=32,
        batch=512,
        replay_capacity=1024000,
        target_period=100,
    ),
)

_SMOKE = Config(
    detector=DetectorConfig(num_scans=3072, num_held_out=1536, steps=300, batch=128),
    jmvae=JmvaeConfig(restarts=1, samples_per_class=512, steps=300, batch=128),
    dqn=DqnConfig(
        observe="bank",
        num_envs=32,
        epochs=60,
        chunk=20,
        batch=64,
        replay_capacity=2048,
        num_starts=64,
    ),
    evaluation=EvaluationConfig(num_starts=32, num_repeats=1),
    mission=MissionConfig(episodes=4, time_limit=60.0),
)

PRESETS: dict[str, Config] = {"default": Config(), "paper": _PAPER, "smoke": _SMOKE}
"""`default`: the best settings we know. `paper`: those of the paper, and those of its authors' code
where the paper is silent. `smoke`: the whole pipeline in seconds, for tests."""
