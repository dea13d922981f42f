"""Presets: ready-made settings of a run, by name."""

import dataclasses
from collections.abc import Mapping

from jaxsense.config.learning import (
    DetectorConfig,
    DqnConfig,
    EvaluationConfig,
    JmvaeConfig,
    MdpConfig,
    TeamConfig,
)
from jaxsense.config.mission import MissionConfig, NavigationConfig
from jaxsense.config.scene import (
    COLOURS,
    SHAPES,
    ArenaConfig,
    CameraConfig,
    LidarConfig,
    Shape,
    ViewpointConfig,
)
from jaxsense.config.section import FrozenDict
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
        task="map",
        hidden=(24, 24),
        discount=0.95,
        epochs=2000,
        updates=32,
        replay_capacity=1024000,
        epsilon_min=0.01,
        target_period=100,
    ),
)

_SMOKE = Config(
    detector=DetectorConfig(num_scans=3072, num_held_out=1536, steps=300, batch=128),
    jmvae=JmvaeConfig(restarts=1, samples_per_class=512, steps=300, batch=128),
    dqn=DqnConfig(
        task="map",
        hidden=(24, 24),
        num_envs=32,
        epochs=60,
        updates=64,
        batch=64,
        replay_capacity=2048,
        discount=0.5,
        epsilon_min=0.01,
        target_period=50,
    ),
    evaluation=EvaluationConfig(
        num_starts=32,
        num_repeats=1,
        num_histories=1020,
        num_states=384,
        value_looks=16,
    ),
    mission=MissionConfig(episodes=4, time_limit=60.0),
)

_NOISY = Config(
    arena=ArenaConfig(side=8.0),
    lidar=LidarConfig(
        range_noise=0.02,
        range_noise_growth=0.01,
        mixed_pixels=0.05,
        dropout=0.01,
        window_range=5.0,
    ),
    camera=CameraConfig(
        pixel_noise=0.1,
        exposure_error=0.3,
        colour_cast=0.3,
        low_light=0.95,
        shadow=0.3,
        stride=2,
    ),
    viewpoint=ViewpointConfig(max_distance=4.0),
    detector=DetectorConfig(
        hidden=(64, 64, 64),
        num_scans=131072,
        calibration=0.1,
        num_held_out=32768,
        num_repeats=12288,
    ),
    jmvae=JmvaeConfig(fusion="filter", samples_per_class=8000),
    mdp=MdpConfig(reward="nats"),
    dqn=DqnConfig(hidden=(64, 64), epochs=600),
    team=TeamConfig(sides=(4.0, 9.0)),
    evaluation=EvaluationConfig(num_histories=65520, value_looks=128),
    navigation=NavigationConfig(view_range=4.0),
    mission=MissionConfig(
        policies=(
            *("latent", "greedy", "bayes", "optimal", "naive", "naive_2", "naive_3", "random"),
            *("nearest", "auction", "rollout"),
        ),
        episodes=64,
        least_confidence=0.0,
    ),
)

_RAW = Config(
    detector=DetectorConfig(calibration=0.1),
    jmvae=JmvaeConfig(
        learns_from="scans",
        hidden=(128, 128),
        alpha=3.0,
        beta=1.0,
        initial_beta=0.01,
        annealing=0.3,
        reconstruction_weights=(10.0, 60.0),
        fusion="filter",
        restarts=1,
        steps=4000,
        batch=128,
    ),
    dqn=DqnConfig(hidden=(64, 64), epochs=600),
    team=TeamConfig(num_pois=(3, 8), sides=(3.0, 6.0)),
)

_TEAM = Config(
    arena=ArenaConfig(side=4.0, num_pois=8),
    dqn=DqnConfig(hidden=(64, 64), epochs=1200),
    team=TeamConfig(num_pois=(3, 8), sides=(3.0, 6.0)),
    evaluation=EvaluationConfig(num_pois=(3, 8, 20)),
    mission=MissionConfig(
        policies=("latent", "nearest", "auction", "rollout", "naive", "random"), time_limit=300.0
    ),
)

_FOUR_SHAPES = {
    **SHAPES,
    # From its broad side like a cube, from its narrow side like a post.
    "slab": Shape("box", half_sides=(1.0, 0.5)),
    "post": Shape("box", half_sides=(0.5, 0.5)),
}

_MANY = dataclasses.replace(
    _NOISY,
    robots=("camera", "camera", "lidar", "lidar"),
    arena=ArenaConfig(
        side=8.0,
        num_pois=8,
        # Four shapes need more beams than two.
        poi_radius=0.15,
        classes=tuple(f"{colour} {shape}" for colour in COLOURS for shape in _FOUR_SHAPES),
        shapes=_FOUR_SHAPES,
    ),
    jmvae=dataclasses.replace(_NOISY.jmvae, latent_size=6, samples_per_class=4000),
    dqn=DqnConfig(hidden=(64, 64), updates=32, epochs=600),
    team=dataclasses.replace(_NOISY.team, num_pois=(3, 8)),
    evaluation=dataclasses.replace(_NOISY.evaluation, num_repeats=8, num_states=512),
    mission=dataclasses.replace(
        _NOISY.mission,
        policies=(
            "latent",
            "greedy",
            "nearest",
            "auction",
            "naive",
            "naive_2",
            "naive_3",
            "random",
        ),
        episodes=32,
        time_limit=300.0,
    ),
)

# `recorded.fit_noise` of 704 laser scans, see `docs/robot.md`.
_RECORDED = Config(
    lidar=LidarConfig(
        range_noise=0.0048, range_noise_growth=0.0005, mixed_pixels=0.21, dropout=0.00024
    )
)

PRESETS: Mapping[str, Config] = FrozenDict(
    {
        "default": Config(),
        "paper": _PAPER,
        "noisy": _NOISY,
        "many": _MANY,
        "raw": _RAW,
        "team": _TEAM,
        "recorded": _RECORDED,
        "smoke": _SMOKE,
    }
)
"""Ready-made settings of a run, by name.

`default`: the best settings we know. `paper`: the paper's settings where it states them, otherwise
settings chosen to reproduce its figures, see `docs/differences.md`. `noisy`: detections that are
often uncertain, and beliefs that accumulate looks. `many`: sixteen classes of four colours and four
shapes, with the sensors of `noisy` and a team. `raw`: `default`, but the JMVAE learns from scans
themselves, without detectors or labels. `team`: one policy for any number of PoIs and robots that
takes travel time into account. `recorded`: `default` with the noise of a real laser scanner.
`smoke`: the whole pipeline with very little training, for tests.
"""
