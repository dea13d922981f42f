"""Minibatch training as one `lax.scan`."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax

from jaxsense.core.networks import Params
from jaxsense.core.types import pytree


@pytree
class FitState:
    """Training state between two calls of `fit`.

    Attributes:
      params: of the network.
      optimiser: state of the optimiser.
      step: `[]` int32 gradient steps so far.
    """

    params: Params
    optimiser: optax.OptState
    step: jax.Array


def adam(learning_rate: float, steps: int) -> optax.GradientTransformation:
    """Adam with a learning rate that falls from `learning_rate` to zero along a cosine."""
    # As one vector: the networks are so small that each array costs more than its content.
    return optax.flatten(optax.adam(optax.cosine_decay_schedule(learning_rate, steps)))


def start(params: Params, optimiser: optax.GradientTransformation) -> FitState:
    """The state before the first step."""
    return FitState(params, optimiser.init(params), jnp.int32(0))


def fit(
    state: FitState,
    loss: Callable[[Params, Any, jax.Array], jax.Array],
    drawn: Any,
    optimiser: optax.GradientTransformation,
    total: int | None = None,
) -> tuple[FitState, jax.Array]:
    """Makes gradient steps, at most up to the end of the whole training.

    Args:
      state: where to start.
      loss: `(params, drawn, step) -> []`, where step counts from the start of the training.
      drawn: pytree of `[steps, ...]` arrays, everything random in each step. Drawing all steps at
        once is much cheaper than drawing in the loop.
      optimiser: of optax.
      total: steps of the whole training; by default no limit.

    Returns:
      The state after the last step and the `[steps]` losses; those beyond `total` mean nothing.
      Non-finite values raise no error: the last meaningful loss is NaN if the parameters after it
      are not finite.
    """
    steps = jax.tree.leaves(drawn)[0].shape[0]

    def make_step(state: FitState, drawn: Any) -> tuple[FitState, jax.Array]:
        value, gradient = jax.value_and_grad(loss)(state.params, drawn, state.step)
        update, optimiser_state = optimiser.update(gradient, state.optimiser, state.params)
        params = optax.apply_updates(state.params, update)
        after = FitState(params, optimiser_state, state.step + 1)
        if total is not None and total % steps:
            goes_on = state.step < total
            after = jax.tree.map(lambda new, old: jnp.where(goes_on, new, old), after, state)
        return after, value

    after, losses = jax.lax.scan(make_step, state, drawn)
    # Earlier parameters show in the loss of the next step.
    is_finite = jnp.stack([jnp.isfinite(x).all() for x in jax.tree.leaves(after.params)]).all()
    last = jnp.maximum(after.step - state.step - 1, 0)
    return after, jnp.asarray(losses).at[last].mul(jnp.where(is_finite, 1.0, jnp.nan))
