"""The supervised fit of detectors, the JMVAE and the filter: one `lax.scan`."""

import dataclasses
from collections.abc import Callable
from typing import Generic, TypeVar

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int

from jaxsense.core.networks import Params
from jaxsense.core.types import Key, pytree

D = TypeVar("D")


@dataclasses.dataclass(frozen=True)
class Problem(Generic[D]):
    """A loss to minimise, with its data.

    Attributes:
      steps: gradient steps of the whole fit.
      learning_rate: Adam's in the first step; it falls to zero along a cosine.
      draw: `(key, number) -> [number, ...]` random values of all steps, much cheaper together than
        step by step.
      loss: `(params, drawn, step) -> []` loss of one step of the whole fit, with a row of what
        `draw` returns.
    """

    steps: int
    learning_rate: float | jax.Array
    draw: Callable[[Key, int], D]
    loss: Callable[[Params, D, Int[Array, ""]], Float[Array, ""]]


@pytree
class FitState:
    """State of a fit between two chunks of steps.

    Attributes:
      step: `[]` int32 number of gradient steps so far.
      loss: `[]` mean loss of the last chunk; infinite before the first.
    """

    params: Params
    optimiser: optax.OptState
    step: jax.Array
    loss: jax.Array


def adam(
    learning_rate: float | jax.Array, steps: int, last: float = 0.0
) -> optax.GradientTransformation:
    """Adam with a learning rate that falls along a cosine.

    Args:
      steps: until the learning rate stays.
      last: share of the learning rate that is left then.
    """
    # Flattened: for networks this small, per-array overhead dominates.
    return optax.flatten(optax.adam(optax.cosine_decay_schedule(learning_rate, steps, last)))


def start(params: Params, problem: Problem[D]) -> FitState:
    """State before the first step."""
    optimiser = adam(problem.learning_rate, problem.steps).init(params)
    return FitState(params, optimiser, jnp.int32(0), jnp.float32(jnp.inf))


def fit(
    key: Key, state: FitState, problem: Problem[D], number: int
) -> tuple[FitState, Float[Array, "{number}"]]:
    """Takes a static number of gradient steps, at most until the end of the whole fit.

    Returns:
      The state after the last step and the losses, without meaning beyond the end of the fit. The
      last one of the fit is NaN if the parameters after it are not finite.
    """
    optimiser, total = adam(problem.learning_rate, problem.steps), problem.steps
    drawn = problem.draw(key, number)

    def make_step(state: FitState, drawn: D) -> tuple[FitState, jax.Array]:
        value, gradient = jax.value_and_grad(problem.loss)(state.params, drawn, state.step)
        update, optimiser_state = optimiser.update(gradient, state.optimiser, state.params)
        params = optax.apply_updates(state.params, update)
        after = FitState(params, optimiser_state, state.step + 1, state.loss)
        if total % number:
            goes_on = state.step < total
            after = jax.tree.map(lambda new, old: jnp.where(goes_on, new, old), after, state)
        return after, value

    after, losses = jax.lax.scan(make_step, state, drawn)
    losses = jnp.asarray(losses)
    # Earlier non-finite parameters make the next loss NaN.
    is_finite = jnp.stack([jnp.isfinite(x).all() for x in jax.tree.leaves(after.params)]).all()
    last = jnp.maximum(after.step - state.step - 1, 0)
    losses = losses.at[last].mul(jnp.where(is_finite, 1.0, jnp.nan))
    counts = state.step + jnp.arange(number) < total
    mean = jnp.mean(losses, where=counts)
    return FitState(after.params, after.optimiser, after.step, mean), losses
