"""The stages that make the fusion: in place, or a filter that learns from histories of looks."""

import dataclasses
from collections.abc import Callable

from jaxsense.config import Config
from jaxsense.core.networks import Params
from jaxsense.core.supervised import FitState
from jaxsense.core.types import Belief, Key
from jaxsense.models import make_in_place, make_jmvae, make_prior
from jaxsense.training.detections import Detections
from jaxsense.training.fits import fit_stage
from jaxsense.training.stage import Output, Stage
from jaxsense.vae import filter
from jaxsense.vae.filter import Filter
from jaxsense.vae.fusion import InPlace, train_decoders


def make_stages(config: Config) -> list[Stage]:
    """Makes the stages of `config.jmvae.fusion`, the last of which is called `fusion`."""
    kinds: dict[str, Callable[[Config], list[Stage]]] = {
        "in_place": _in_place_stages,
        "filter": _filter_stages,
    }
    return kinds[config.jmvae.fusion](config)


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


def _in_place_stages(config: Config) -> list[Stage]:
    """The stage that makes the fusion in place."""
    del config
    given = {"params": "best_jmvae", "classes": "class_beliefs", "detections": "detections"}
    return [Stage("fusion", fit_in_place, given, is_kept=True)]


def _filter_stages(config: Config) -> list[Stage]:
    """The training of the filter, and the stage that returns it as the fusion."""

    def untrained(
        key: Key, config: Config, *, classes: Belief, detections: Detections
    ) -> tuple[Filter, Params]:
        found = filter.init(key, make_jmvae(config), classes, make_prior(config), config.filter)
        return found, found.networks

    def problem(
        config: Config, fitted: Filter, *, classes: Belief, detections: Detections
    ) -> filter.Fitting:
        del classes
        return filter.Fitting(config.filter, fitted, detections.bank)

    def trained(config: Config, fitted: Filter, fit: FitState, **_: Output) -> Filter:
        return dataclasses.replace(fitted, networks=fit.params)

    training = fit_stage(
        "filter",
        {"classes": "class_beliefs", "detections": "detections"},
        config,
        settings=lambda config: config.filter,
        untrained=untrained,
        problem=problem,
        trained=trained,
    )
    # The key of a training depends on the name of its stage.
    fusion = Stage("fusion", _filter, {"fusion": "filter"}, is_kept=True)
    return [training, fusion]


def _filter(key: Key, config: Config, *, fusion: Filter) -> Filter:
    del key, config
    return fusion
