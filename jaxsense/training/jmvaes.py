"""Stages of a JMVAE that learns from detections: restarts, the best of them, class beliefs."""

import jax
import jax.numpy as jnp

from jaxsense.config import Config
from jaxsense.core.networks import Params
from jaxsense.core.types import Belief, Key
from jaxsense.models import make_jmvae, make_prior, make_readout
from jaxsense.training import histories, stage
from jaxsense.training.detections import Detections
from jaxsense.training.stage import Stage
from jaxsense.vae import jmvae

_EXACT = 0.003  # nats that a readout may lose, a third of what a sound map may


def restarts(config: Config) -> list[Stage]:
    """Makes the stages that train the JMVAE from different random parameters."""

    def untrained(key: Key, config: Config, *, detections: Detections) -> tuple[tuple[()], Params]:
        del detections
        return (), jmvae.init(key, make_jmvae(config))

    def problem(config: Config, _: tuple[()], *, detections: Detections) -> jmvae.Fitting:
        return jmvae.Fitting(config.jmvae, detections.bank, make_jmvae(config))

    return stage.restarts(config, untrained=untrained, problem=problem)


def best(
    key: Key,
    config: Config,
    *,
    restarts: tuple[tuple[Params, jax.Array], ...],
    detections: Detections,
) -> Params:
    """Parameters of the best restart, of finite ones; of the first if none is finite.

    It has the lowest loss of those whose beliefs class probabilities are read from exactly; if
    there are none, it is the one from which they are read most exactly.
    """
    if len(restarts) == 1:
        return restarts[0][0]
    losses = jnp.stack([loss for _, loss in restarts])
    params = jax.tree.map(lambda *x: jnp.stack(x), *(params for params, _ in restarts))

    def error(params: Params) -> jax.Array:
        classes = class_beliefs(key, config, params=params, detections=detections)
        read, prior = make_readout(config, classes), make_prior(config)
        of_belief = lambda belief: read.class_probabilities(belief, prior)  # noqa: E731
        return histories.readout_error(key, config, detections.bank, classes, of_belief)

    errors = jax.lax.map(error, params)
    inexact = jnp.maximum(errors - _EXACT, 0.0)
    is_finite = jnp.isfinite(losses) & jnp.isfinite(inexact)
    worst_last = [jnp.where(is_finite, x, jnp.inf) for x in (losses, inexact)]
    found = jnp.lexsort(worst_last)[0]
    return jax.tree.map(lambda x: x[found], params)


def class_beliefs(key: Key, config: Config, *, params: Params, detections: Detections) -> Belief:
    """Mean joint posterior of each class, `[C, D]`, from features for training.

    Args:
      key: not used.
      config: all settings.
      params: of the JMVAE.
      detections: see `detections.detect`.
    """
    del key
    model = make_jmvae(config)
    encode = jax.vmap(jax.vmap(lambda features: jmvae.posterior(params, model, features)))
    return jax.tree.map(lambda x: x.mean(axis=1), encode(detections.bank))
