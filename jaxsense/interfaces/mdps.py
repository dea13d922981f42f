"""The map MDP, and that of a team, built from a run's models."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxsense import observe
from jaxsense.config import Config, values
from jaxsense.dqn.belief_mdp import MapMdp
from jaxsense.dqn.team_mdp import TeamMdp
from jaxsense.models import Models, make_jmvae
from jaxsense.observe import Bank
from jaxsense.sim import world as worlds
from jaxsense.types import Key
from jaxsense.vae import detectors


def map_mdp(config: Config, models: Models, bank: Bank | None = None) -> MapMdp:
    """Builds the map MDP from the detectors and the JMVAE of a run.

    Args:
      config: the settings.
      models: from `jaxsense.load`, or `jaxsense.init`.
      bank: stored detections to draw from, for example from `detections`; by default every look
        casts a scan in the environment's own arena.
    """
    shape = make_jmvae(config)
    if bank is not None:
        return observe.bank_mdp(config, bank, models.jmvae, shape)
    world = worlds.make_world(config)
    return observe.live_mdp(config, world, models.detectors, models.jmvae, shape)


def team_mdp(config: Config, models: Models, bank: Bank) -> TeamMdp:
    """Builds the MDP of a team from the JMVAE of a run.

    Args:
      config: the settings, of which `TeamConfig` holds those of the team.
      models: from `jaxsense.load`, or `jaxsense.init`.
      bank: stored detections to draw from, for example from `detections`.
    """
    return observe.team_mdp(config, bank, models.jmvae, make_jmvae(config))


def detections(key: Key, config: Config, models: Models, samples: int) -> Bank:
    """Detections in simulated looks at every class: a bank for `map_mdp` or `team_mdp`.

    Args:
      key: random key.
      config: the settings.
      models: the models.
      samples: looks at each class by each sensor, S.

    Returns:
      For each modality `[C, S, D_m]` features.
    """
    values.require_number("samples", samples)
    num_classes = len(config.arena.classes)
    world = worlds.make_world(config)
    number = -(-samples * num_classes // config.arena.num_pois)

    @jax.jit
    def look(key: Key) -> tuple[jax.Array, Bank]:
        class_key, survey_key = jax.random.split(key)
        classes = observe.balanced_classes(class_key, config, number)
        windows = observe.surveys(jax.random.split(survey_key, number), world, classes)[1]
        features = tuple(
            jax.vmap(jax.vmap(detectors.detect, (None, 0)), (None, 0))(detector, seen)
            for detector, seen in zip(models.detectors, windows, strict=True)
        )
        return classes, features

    classes, features = jax.tree.map(np.asarray, look(key))
    return tuple(
        jnp.stack([jnp.asarray(f[classes == c][:samples]) for c in range(num_classes)])
        for f in features
    )
