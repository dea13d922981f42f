"""Stages that make the fusion: in place, or a filter that learns from histories of looks."""

import dataclasses

from jaxsense.config import Config
from jaxsense.core.networks import Params
from jaxsense.core.supervised import FitState
from jaxsense.core.types import Belief, Key
from jaxsense.models import make_in_place, make_jmvae, make_prior
from jaxsense.training.detections import Detections
from jaxsense.training.stage import Drive, Output, Stage, fit_stage
from jaxsense.vae import filter
from jaxsense.vae.filter import Filter
from jaxsense.vae.fusion import InPlace, train_decoders


def train(
    drive: Drive, config: Config, *, params: Output, classes: Output, detections: Output
) -> Output:
    """The fusion of `config.jmvae.fusion`; see `fit_in_place` for its inputs."""
    given = {"classes": classes, "detections": detections}
    if config.jmvae.fusion == "in_place":
        return drive(Stage("fusion", fit_in_place), params=params, **given)
    # A stage of its own, whose name determines its key.
    found = drive(_filter_stage(config), **given)
    return drive(Stage("fusion", lambda key, config, fusion: fusion), fusion=found)


def fit_in_place(
    key: Key, config: Config, *, params: Params, classes: Belief, detections: Detections
) -> InPlace:
    """Fusion in place, with decoders that have learned to decode beliefs.

    Args:
      key: random key of the training.
      config: all settings.
      params: of the JMVAE.
      classes: `[C, D]` mean joint posterior of each class.
      detections: see `detect`.
    """
    settings = dataclasses.replace(config.jmvae, steps=-(-config.jmvae.steps // 3))
    bank, model = detections.bank, make_jmvae(config)
    return make_in_place(config, train_decoders(key, params, model, bank, settings), classes)


def _filter_stage(config: Config) -> Stage:
    """The training of the filter."""

    def untrained(
        key: Key, config: Config, *, classes: Belief, detections: Detections
    ) -> tuple[Filter, Params]:
        found = filter.init(key, make_jmvae(config), classes, make_prior(config))
        return found, found.networks

    def problem(
        config: Config, fitted: Filter, *, classes: Belief, detections: Detections
    ) -> filter.Fitting:
        del classes
        return filter.Fitting(config.filter, fitted, detections.bank)

    def trained(config: Config, fitted: Filter, fit: FitState, **_: Output) -> Filter:
        return dataclasses.replace(fitted, networks=fit.params)

    return fit_stage("filter", config.filter, untrained=untrained, problem=problem, trained=trained)
