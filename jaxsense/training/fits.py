"""Stages that fit a network: detectors, the JMVAE and the filter."""

import dataclasses
from collections.abc import Callable, Mapping

import jax

from jaxsense.config import Config
from jaxsense.core import supervised
from jaxsense.core.networks import Params
from jaxsense.core.supervised import FitConfig, FitState, Problem
from jaxsense.core.types import Key
from jaxsense.training.stage import Output, Progress, Stage, chunk_size, num_chunks

State = tuple[Output, FitState]
"""The untrained model, and the state of the fit."""


def fit_stage(
    name: str,
    inputs: Mapping[str, str | tuple[str, ...] | int],
    config: Config,
    *,
    settings: Callable[[Config], FitConfig],
    untrained: Callable[..., tuple[Output, Params]],
    problem: Callable[..., Problem[Output]],
    trained: Callable[..., Output],
    is_optional: bool = False,
) -> Stage:
    """Makes a stage that fits a network.

    Args:
      name: of the stage.
      inputs: see `Stage`.
      config: all settings, which determine the number of steps.
      settings: `config -> settings of the fit`.
      untrained: `(key, config, **inputs) -> (model, parameters to fit)`.
      problem: `(config, model, **inputs) -> Problem`.
      trained: `(config, model, FitState, **inputs) -> output`.
      is_optional: see `Stage`.
    """
    steps = settings(config).steps
    size = chunk_size(steps)

    def begin(key: Key, config: Config, **inputs: Output) -> State:
        model, params = untrained(key, config, **inputs)
        return model, supervised.start(params, settings(config))

    def advance(key: Key, config: Config, state: State, **inputs: Output) -> tuple[State, Progress]:
        model, fit = state
        fit, losses = supervised.fit(key, fit, problem(config, model, **inputs), size)
        return (model, fit), Progress(losses, {})

    def finish(config: Config, state: State, **inputs: Output) -> Output:
        model, fit = state
        return trained(config, model, fit, **inputs)

    return Stage(
        name,
        begin,
        inputs,
        advance=advance,
        finish=finish,
        steps=steps,
        chunks=num_chunks(steps),
        is_optional=is_optional,
    )


def jmvae_restarts(
    config: Config,
    inputs: Mapping[str, str],
    *,
    init: Callable[[Key, Config], Params],
    problem: Callable[..., Problem[Output]],
) -> list[Stage]:
    """Makes the stages that train a JMVAE from different random parameters.

    Each outputs the parameters and the `[]` mean loss of the last chunk.

    Args:
      config: all settings.
      inputs: see `Stage`.
      init: `(key, config) -> random parameters`.
      problem: `(config, **inputs) -> Problem`.
    """

    def trained(
        config: Config, model: Output, fit: FitState, **inputs: Output
    ) -> tuple[Params, jax.Array]:
        return fit.params, fit.loss

    stage = fit_stage(
        "jmvae",
        inputs,
        config,
        settings=lambda config: config.jmvae,
        untrained=lambda key, config, **inputs: ((), init(key, config)),
        problem=lambda config, model, **inputs: problem(config, **inputs),
        trained=trained,
        is_optional=config.jmvae.restarts > 1,
    )
    # The newer code generator of a CPU trains a JMVAE a tenth faster, other networks a twentieth at
    # most, and takes half as long again and four times the memory to compile.
    stage = dataclasses.replace(stage, shares=stage.name, runs_long=True)
    return [dataclasses.replace(stage, name=f"jmvae_{i + 1}") for i in range(config.jmvae.restarts)]
