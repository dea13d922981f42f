"""The map MDP, and that of a team, built from a run's models."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxsense import observe
from jaxsense.config import Config
from jaxsense.core import checks
from jaxsense.core.types import Key
from jaxsense.dqn.belief_mdp import MapMdp
from jaxsense.dqn.team_mdp import TeamMdp
from jaxsense.models import Models, init, make_jmvae
from jaxsense.observe import Bank
from jaxsense.sim import world as worlds
from jaxsense.vae import detectors


def map_mdp(config: Config, models: Models, bank: Bank | None = None) -> MapMdp:
    """Builds the map MDP from the detectors and the JMVAE of a run.

    Args:
      config: the settings.
      models: from `jaxsense.load`, or `jaxsense.init`.
      bank: stored detections to draw from, for example from `detections`; by default every look
        casts a scan in the environment's own arena.

    Raises:
      ValueError: if the detectors or the JMVAE have other shapes than the settings ask for.
    """
    _require_jmvae(config, models)
    shape = make_jmvae(config)
    if bank is not None:
        return observe.bank_mdp(config, bank, models.jmvae, shape)
    world = worlds.make_world(config)
    _require_windows(world, models)
    return observe.live_mdp(config, world, models.detectors, models.jmvae, shape)


def team_mdp(config: Config, models: Models, bank: Bank) -> TeamMdp:
    """Builds the MDP of a team from the JMVAE of a run.

    Args:
      config: the settings, of which `TeamConfig` holds those of the team.
      models: from `jaxsense.load`, or `jaxsense.init`.
      bank: stored detections to draw from, for example from `detections`.

    Raises:
      ValueError: if the JMVAE has other shapes than the settings ask for.
    """
    _require_jmvae(config, models)
    return observe.team_mdp(config, bank, models.jmvae, make_jmvae(config))


def _require_jmvae(config: Config, models: Models) -> None:
    """Raises `ValueError` unless the JMVAE has the shapes that the settings ask for."""
    if not isinstance(models, Models):
        raise ValueError(f"models = {type(models).__name__}: must be Models, as from jaxsense.load")
    expected, here = jax.tree.flatten(jax.eval_shape(lambda: init(jax.random.key(0), config).jmvae))
    found, there = jax.tree.flatten(models.jmvae)
    if here != there or [x.shape for x in found] != [x.shape for x in expected]:
        raise ValueError("models.jmvae: must have the shapes of config; take both from one run")


def _require_windows(world: worlds.World, models: Models) -> None:
    """Raises `ValueError` unless each detector reads its sensor's windows."""
    for sensor, detector in zip(world.sensors, models.detectors, strict=True):
        size, found = sensor.window * sensor.channels, detector.offset.size
        if found != size:
            reason = f"reads windows of {found} numbers; must be of {size}, as config's are"
            raise ValueError(f"models.detectors of {sensor.name}: {reason}")


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
    checks.require_number("samples", samples)
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
