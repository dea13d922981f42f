"""Stages that fit a network: detectors, the JMVAE and the filter differ in their problems alone."""

from collections.abc import Callable, Mapping
from typing import Any

from jaxsense.config import Config
from jaxsense.core import supervised
from jaxsense.core.networks import Params
from jaxsense.core.supervised import FitConfig, FitState, Problem
from jaxsense.core.types import Key
from jaxsense.training.stage import Output, Progress, Stage, chunk_size, num_chunks

State = tuple[Output, FitState]
"""What the fit starts from, and its state."""


def fit_stage(
    name: str,
    inputs: Mapping[str, str | tuple[str, ...] | int],
    config: Config,
    *,
    settings: Callable[[Config], FitConfig],
    untrained: Callable[..., tuple[Output, Params]],
    problem: Callable[..., Problem[Any]],
    trained: Callable[..., Output],
    is_optional: bool = False,
) -> Stage:
    """A stage that fits a network.

    Args:
      name: of the stage.
      inputs: see `Stage`.
      config: all settings, which determine the number of steps.
      settings: of the fit, among all settings.
      untrained: `(key, config, **inputs) -> (what is fitted, its parameters)`.
      problem: `(config, what is fitted, **inputs) -> Problem`.
      trained: `(config, what is fitted, FitState, **inputs) -> output`.
      is_optional: see `Stage`.
    """
    steps = settings(config).steps
    size = chunk_size(steps)

    def begin(key: Key, config: Config, **inputs: Output) -> State:
        fitted, params = untrained(key, config, **inputs)
        return fitted, supervised.start(params, settings(config))

    def advance(key: Key, config: Config, state: State, **inputs: Output) -> tuple[State, Progress]:
        fitted, fit = state
        fit, losses = supervised.fit(key, fit, problem(config, fitted, **inputs), size)
        return (fitted, fit), Progress(losses, {})

    def finish(config: Config, state: State, **inputs: Output) -> Output:
        fitted, fit = state
        return trained(config, fitted, fit, **inputs)

    chunks = num_chunks(steps)
    return Stage(name, begin, inputs, advance, finish, steps, chunks, is_optional)
