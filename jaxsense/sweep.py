"""Many trainings in one program: over seeds, and over settings.

`learning.learn` is a pure function of key and settings, so that JAX's `vmap` makes many trainings
of it. Seeds are keys; a setting that enters the arithmetic only, such as a weight of a loss or a
learning rate, can be an array as well::

    config, alphas = PRESETS["smoke"], jnp.array([0.01, 0.1, 1.0])
    world = jaxsense.sim.make_world(config)

    def train(alpha):
        return learn(key, vary(config, {"jmvae.alpha": alpha}), world)

    learned = jax.jit(jax.vmap(train))(alphas)

Sizes, numbers of steps and whatever else decides what is compiled cannot be varied so.
"""

import copy
from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy.stats

from jaxsense.config import Config, ConfigError

VARIABLE: tuple[str, ...] = (
    "detector.learning_rate",
    "jmvae.alpha",
    "jmvae.beta",
    "jmvae.initial_beta",
    "jmvae.learning_rate",
    "mdp.min_increase",
    "mdp.unseen_variance",
    "dqn.discount",
    "dqn.learning_rate",
    "dqn.final_learning_rate",
    "dqn.epsilon_start",
    "dqn.epsilon_min",
    "dqn.epsilon_decay",
)
"""Settings that enter the arithmetic only."""
_CONFIDENCE = 0.95


def vary(config: Config, values: dict[str, Any]) -> Config:
    """Settings of which some are arrays, or traced values of a `vmap`.

    Args:
      config: the other settings.
      values: by name, for example `{"jmvae.alpha": alpha}`; one of `VARIABLE`. What they are worth
        is not checked: out of their range the training may end in NaN.

    Raises:
      ConfigError: if a setting cannot be varied.
    """
    changed = copy.copy(config)
    for name, value in values.items():
        if name not in VARIABLE:
            reason = f"cannot be varied in one program; must be one of {', '.join(VARIABLE)}"
            raise ConfigError(name, value, reason)
        section_name, _, field = name.partition(".")
        section = copy.copy(getattr(changed, section_name))
        # Past the checks of the section, which a traced value would not stand.
        object.__setattr__(section, field, value)
        object.__setattr__(changed, section_name, section)
    return changed


def statistics(summaries: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Mean and confidence of every figure of several summaries.

    Args:
      summaries: the blocks of several runs, of the same structure; two or more.

    Returns:
      The same structure, with `{"mean", "low", "high"}` in place of every number: the mean and the
      95% interval of it by Student's t. Left out is what not every run has, and what is neither a
      number nor holds numbers; in a list, None takes its place.
    """
    return _statistics(list(summaries)) or {}


def totals(timings: Sequence[dict[str, dict[str, float]]]) -> dict[str, dict[str, float]]:
    """The seconds of each stage of several runs together."""
    found: dict[str, dict[str, float]] = {}
    for timing in timings:
        for stage, seconds in timing.items():
            entry = found.setdefault(stage, dict.fromkeys(seconds, 0.0))
            for kind, value in seconds.items():
                entry[kind] += value
    return found


def _statistics(values: list[Any]) -> Any:
    first = next((value for value in values if value is not None), None)
    if isinstance(first, dict):
        names = [name for name in first if all(isinstance(v, dict) and name in v for v in values)]
        found = {name: _statistics([v[name] for v in values]) for name in names}
        return {name: value for name, value in found.items() if value is not None}
    if isinstance(first, list):
        return [_statistics(list(row)) for row in zip(*values, strict=True)]
    if isinstance(first, bool | int | float):
        return None if None in values else _interval(np.array(values, float))
    return None


def _interval(values: np.ndarray) -> dict[str, float]:
    mean = float(values.mean())
    error = float(scipy.stats.sem(values)) if len(values) > 1 else 0.0
    low, high = mean, mean
    if error > 0:
        low, high = scipy.stats.t.interval(_CONFIDENCE, len(values) - 1, loc=mean, scale=error)
    return {"mean": mean, "low": float(low), "high": float(high)}
