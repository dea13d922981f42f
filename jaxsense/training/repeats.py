"""The stage that learns how much of a repeated look is new."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from jaxsense import looks
from jaxsense.config import Config
from jaxsense.core.types import Key, pytree
from jaxsense.models import make_bayes
from jaxsense.sim.arena import Arena
from jaxsense.sim.world import make_world
from jaxsense.training.stage import Output, Stage
from jaxsense.vae import detectors, novelty
from jaxsense.vae.detectors import Detector
from jaxsense.vae.novelty import Novelty

_REPEATS = 4  # looks in a scene


@pytree
class Repeated:
    """Scenes at whose first PoIs a sensor looks again and again.

    Attributes:
      classes: of the PoIs in the simulation.
      places: `[S]` keys, see `looks.repeats`; None for any.
      taken_for: class to learn that the first PoI shows.
    """

    classes: Int[Array, "S N"]
    places: Key | None
    taken_for: Int[Array, " S"]


def random_scenes(key: Key, config: Config) -> Repeated:
    """Scenes with PoIs of random classes, which are known."""
    shape = config.detector.num_repeats, config.arena.num_pois
    classes = jax.random.randint(key, shape, 0, len(config.arena.classes))
    return Repeated(classes, None, classes[:, 0])


def novelty_stage(
    arena: Arena, config: Config, scenes: Callable[..., Repeated] = random_scenes
) -> Stage:
    """Makes the stage that learns how much of a look is new; all of it without such scenes.

    `scenes(key, config, **inputs)` draws `detector.num_repeats` of them.
    """
    number = config.detector.num_repeats

    def begin(
        key: Key, config: Config, *, trained: tuple[Detector, ...], **given: Output
    ) -> Novelty:
        if not number:
            return novelty.independent(len(trained))
        world, exact = make_world(config, arena=arena), make_bayes(config)
        class_key, *keys = jax.random.split(key, 1 + len(trained))
        drawn = scenes(class_key, config, **given)

        def fit(m: int) -> tuple[jax.Array, jax.Array]:
            scene_keys = jax.random.split(keys[m], number)
            *seen, places = looks.repeats(
                scene_keys, world, drawn.classes, m, _REPEATS, drawn.places
            )

            def read(*look: jax.Array) -> jax.Array:
                return exact.log_likelihoods(detectors.features(trained[m], *look), m)

            return novelty.fit(jax.vmap(jax.vmap(read))(*seen), places, drawn.taken_for)

        strength, length = zip(*map(fit, range(len(trained))), strict=True)
        return Novelty(jnp.stack(strength), jnp.stack(length))

    return Stage("novelty", begin)
