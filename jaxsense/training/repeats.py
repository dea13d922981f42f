"""The stage that learns how much of a repeated look is new."""

import jax
import jax.numpy as jnp

from jaxsense import looks
from jaxsense.config import Config
from jaxsense.core.types import Key
from jaxsense.models import make_bayes
from jaxsense.sim.arena import Arena
from jaxsense.sim.world import make_world
from jaxsense.training.stage import Stage
from jaxsense.vae import detectors, novelty
from jaxsense.vae.detectors import Detector
from jaxsense.vae.novelty import Novelty

_REPEATS = 4  # looks in a scene


def novelty_stage(arena: Arena, config: Config) -> Stage:
    """Makes the stage that learns how much of a look is new; all of it if there are no pairs.

    Args:
      arena: of the simulation.
      config: all settings.
    """
    number = config.detector.num_repeats
    if not number:
        num_modalities = len(config.modalities)
        return Stage("novelty", lambda key, config: novelty.independent(num_modalities))

    def begin(key: Key, config: Config, *, trained: tuple[Detector, ...]) -> Novelty:
        world, exact = make_world(config, arena=arena), make_bayes(config)
        class_key, *keys = jax.random.split(key, 1 + len(trained))
        classes = jax.random.randint(
            class_key, (number, config.arena.num_pois), 0, len(config.arena.classes)
        )

        def fit(m: int) -> tuple[jax.Array, jax.Array]:
            scene_keys = jax.random.split(keys[m], number)
            windows, places = looks.repeats(scene_keys, world, classes, m, _REPEATS)
            read = lambda x: exact.log_likelihoods(detectors.detect(trained[m], x), m)  # noqa: E731
            return novelty.fit(jax.vmap(jax.vmap(read))(windows), places, classes[:, 0])

        strength, length = zip(*map(fit, range(len(trained))), strict=True)
        return Novelty(jnp.stack(strength), jnp.stack(length))

    names = tuple(f"detector_{name}" for name in config.modalities)
    return Stage("novelty", begin, {"trained": names})
