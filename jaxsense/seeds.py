"""Several seeds in one vmapped program, each with a run directory of its own."""

from typing import Any

import jax
import numpy as np

from jaxsense import examine, mission
from jaxsense.checkpoints import Checkpoints
from jaxsense.compilation import Compiler, Kept, Program
from jaxsense.config import Config
from jaxsense.learning import Learned, learn
from jaxsense.monitor import Monitor, StageError
from jaxsense.pipeline import RunResult, as_lists
from jaxsense.sim.world import make_world


def run(
    seeds: range,
    config: Config,
    monitor: Monitor,
    checkpoints: Checkpoints,
    kept: Kept | None = None,
) -> dict[int, RunResult]:
    """Trains all seeds side by side and plays missions with each.

    Args:
      seeds: of all randomness.
      config: all settings.
      monitor: is told of time and progress.
      checkpoints: where what has been learned is saved, before missions are played with it; what
        is there already, from the same seeds and settings, is not learned again.
      kept: where compiled programs are kept for later runs, if anywhere.

    Returns:
      The result of each seed.

    Raises:
      StageError: if a loss of a seed is not finite.
      Stopped: if the monitor was told to stop, which is looked at after learning.
      ConfigError: if a checkpoint is damaged.
      OSError: if a checkpoint cannot be written.
    """
    world = make_world(config)
    keys = jax.vmap(jax.random.key)(np.array(seeds, np.uint32))
    learn_keys, mission_keys = jax.vmap(jax.random.split, out_axes=1)(keys)
    with Compiler(monitor, kept) as compiler:
        program = Program(compiler, "learn", "run")
        learn_all = jax.vmap(lambda key: learn(key, config, world))
        shapes = program.compile(learn_all, learn_keys)
        team, episodes = mission.make_mission(config), config.mission.episodes
        batch = mission.batch_of(len(mission.POLICIES) * episodes)
        player = mission.Player(team, compiler, batch)
        learned = checkpoints.load("learned", shapes)
        if learned is None:
            learned = jax.tree.map(np.asarray, program(learn_keys))
            checkpoints.save("learned", learned)
        monitor.progress("learn", 1, 1)
        played = {n: c for n, c in mission.cases(config).items() if n in mission.POLICIES}
        results = {}
        for i, seed in enumerate(seeds):
            one: Learned = jax.tree.map(lambda x: x[i], learned)  # noqa: B023
            if not one.is_finite:
                raise StageError(f"learn: a loss of seed {seed} is not finite")
            missions = mission.summary(mission_keys[i], player, one.models, played, episodes)
            assert player.recording is not None
            results[seed] = _result(config, one, missions, player.recording)
    return results


def _result(
    config: Config, learned: Learned, missions: dict[str, Any], recording: mission.Recording
) -> RunResult:
    """What `pipeline.run` would give of one seed."""
    names, num_random = config.modalities, config.evaluation.num_starts
    env_steps = {"env_steps": config.dqn.epochs * config.dqn.num_envs}
    figures = [
        {**examine.policy_figures(total, first, num_random), **env_steps}
        for total, first in zip(learned.totals, learned.firsts, strict=True)
    ]
    accuracy = learned.perception.accuracy.tolist()
    return RunResult(
        models=learned.models,
        windows={
            n: np.asarray(window)
            for n, window in zip(names, learned.perception.windows, strict=True)
        },
        posteriors=learned.posteriors,
        rewards={n: np.asarray(r) for n, r in zip(names, learned.reward, strict=True)},
        recording=recording,
        summary={
            "detectors": {n: {"accuracy": a} for n, a in zip(names, accuracy, strict=True)},
            "jmvae": as_lists(learned.latent),
            "dqn": dict(zip(names, figures, strict=True)),
            "mission": missions,
        },
    )
