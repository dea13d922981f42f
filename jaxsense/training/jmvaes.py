"""The best of several JMVAEs, class beliefs, and the fusion."""

import dataclasses
import functools

import jax
import jax.numpy as jnp

from jaxsense.config import Config
from jaxsense.core import supervised
from jaxsense.core.networks import Params
from jaxsense.core.types import Belief, Key
from jaxsense.models import make_in_place, make_jmvae, make_prior, make_readout
from jaxsense.training import measures
from jaxsense.training.detections import Detections
from jaxsense.training.stage import Fit, Stage, fit_stage
from jaxsense.vae import fusion, jmvae
from jaxsense.vae.fusion import Filter, InPlace

_EXACT = 0.003  # nats that a readout may lose, a third of what a sound map may


def start(config: Config, *, detections: Detections) -> Fit:
    """The fit of a JMVAE to detections."""
    model = make_jmvae(config)
    problem = jmvae.problem(config.jmvae, detections.bank, model)
    return Fit.of_params(functools.partial(jmvae.init, model=model), problem)


def best(
    key: Key,
    config: Config,
    *,
    restarts: tuple[tuple[Params, jax.Array], ...],
    detections: Detections | None = None,
) -> Params:
    """Parameters of the best finite restart, or of the first.

    The best has the lowest loss; given detections, the lowest of those with exact class
    probabilities, or else the most exact ones.
    """
    if len(restarts) == 1:
        return restarts[0][0]
    losses = jnp.stack([loss for _, loss in restarts])
    params = jax.tree.map(lambda *x: jnp.stack(x), *(params for params, _ in restarts))
    inexact = jnp.zeros_like(losses)
    if detections is not None:

        def error(params: Params) -> jax.Array:
            classes = class_beliefs(key, config, params=params, detections=detections)
            read, prior = make_readout(config, classes), make_prior(config)
            of_belief = lambda belief: read.class_probabilities(belief, prior)  # noqa: E731
            return measures.readout_error(key, config, detections.bank, classes, of_belief)

        inexact = jnp.maximum(jax.lax.map(error, params) - _EXACT, 0.0)
    is_finite = jnp.isfinite(losses) & jnp.isfinite(inexact)
    worst_last = [jnp.where(is_finite, x, jnp.inf) for x in (losses, inexact)]
    found = jnp.lexsort(worst_last)[0]
    return jax.tree.map(lambda x: x[found], params)


def class_beliefs(key: Key, config: Config, *, params: Params, detections: Detections) -> Belief:
    """Mean joint posterior of each class, `[C, D]`, from features for training."""
    del key
    model = make_jmvae(config)
    encode = jax.vmap(jax.vmap(lambda features: jmvae.posterior(params, model, features)))
    return jax.tree.map(lambda x: x.mean(axis=1), encode(detections.bank))


def fit_in_place(
    key: Key, config: Config, *, params: Params, classes: Belief, detections: Detections
) -> InPlace:
    """Fusion in place, with decoders that have learned to decode beliefs."""
    settings = dataclasses.replace(config.jmvae, steps=-(-config.jmvae.steps // 3))
    problem = fusion.decoding(settings, detections.bank, make_jmvae(config), params)
    start = supervised.start(params["decoders"], problem)
    fit, _ = supervised.fit(key, start, problem, settings.steps)
    return make_in_place(config, {**params, "decoders": fit.params}, classes)


def filter_stage(config: Config) -> Stage:
    """Makes the stage that trains a filter on histories of looks."""

    def fit(config: Config, *, classes: Belief, detections: Detections) -> Fit:
        def untrained(key: Key) -> tuple[Filter, Params]:
            found = fusion.init_filter(key, make_jmvae(config), classes, make_prior(config))
            return found, found.networks

        return Fit(
            untrained,
            lambda found: fusion.filtering(config.filter, found, detections.bank),
            lambda found, fit: dataclasses.replace(found, networks=fit.params),
        )

    return fit_stage("filter", config.filter.steps, fit)
