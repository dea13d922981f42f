"""Minibatch training as one `lax.scan`."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct

from jaxsense.networks import Params
from jaxsense.types import Key

@struct.dataclass
class FitState:
    """A training between two calls of `fit`.

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
    return optax.adam(optax.cosine_decay_schedule(learning_rate, steps))


def start(params: Params, optimiser: optax.GradientTransformation) -> FitState:
    """The state before the first step."""
    return FitState(params, optimiser.init(params), jnp.int32(0))


def fit(
    key: Key,
    state: FitState,
    loss: Callable[[Key, Params, Any, jax.Array], jax.Array],
    draw_batch: Callable[[Key], Any],
    optimiser: optax.GradientTransformation,
    steps: int,
) -> tuple[FitState, jax.Array]:
    """Makes gradient steps.

    Args:
      key: random key.
      state: where to start.
      loss: `(key, params, batch, step) -> []`, where step counts from the start of the training.
      draw_batch: `(key) -> batch`.
      optimiser: of optax.
      steps: how many.

    Returns:
      The state after the last step and the `[steps]` losses. A loss that is not finite is not
      caught here: look at the losses.
    """

    def make_step(state: FitState, keys) -> tuple[FitState, jax.Array]:
        batch_key, loss_key = keys
        batch = draw_batch(batch_key)
        value, gradient = jax.value_and_grad(
            lambda params: loss(loss_key, params, batch, state.step)
        )(state.params)
        update, optimiser_state = optimiser.update(gradient, state.optimiser, state.params)
        params = optax.apply_updates(state.params, update)
        return FitState(params, optimiser_state, state.step + 1), value

    batch_key, loss_key = jax.random.split(key)
    keys = jax.random.split(batch_key, steps), jax.random.split(loss_key, steps)
    state, losses = jax.lax.scan(make_step, state, keys)
    return state, jnp.asarray(losses)
