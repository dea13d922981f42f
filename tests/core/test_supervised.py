"""Minibatch training, on losses whose descent is known."""

import jax.numpy as jnp
import numpy as np
import optax

from jaxsense.core import supervised


def fit(state, optimiser, batches):
    """Fits p to batches with the loss (p - batch)^2 / 2."""
    return supervised.fit(
        state, lambda params, batch, step: 0.5 * (params - batch) ** 2, batches, optimiser
    )


def test_steps_of_gradient_descent_as_worked_by_hand():
    # p <- p - .5 (p - 3): 0, 1.5, and then towards 5: 1.5 + .5 x 3.5 = 3.25.
    optimiser = optax.sgd(0.5)
    start = supervised.start(jnp.float32(0), optimiser)
    state, losses = fit(start, optimiser, jnp.array([3.0, 5.0]))
    np.testing.assert_allclose(state.params, 3.25)
    np.testing.assert_allclose(losses, [4.5, 6.125])  # 3^2 / 2; 3.5^2 / 2
    assert state.step == 2


def test_chunks_go_on_where_the_last_one_stopped():
    optimiser, batches = supervised.adam(0.1, 6), jnp.full(6, 3.0)
    start = supervised.start(jnp.float32(0), optimiser)
    whole, losses = fit(start, optimiser, batches)
    half, first = fit(start, optimiser, batches[:3])
    chunked, second = fit(half, optimiser, batches[3:])
    assert (start.step, half.step, chunked.step, whole.step) == (0, 3, 6, 6)
    np.testing.assert_allclose(chunked.params, whole.params, rtol=1e-6)
    np.testing.assert_allclose(jnp.concatenate([first, second]), losses, rtol=1e-6)


def test_adam_comes_to_rest_at_the_last_step():
    optimiser = supervised.adam(0.1, 6)
    start = supervised.start(jnp.float32(0), optimiser)
    state, _ = fit(start, optimiser, jnp.full(6, 3.0))
    after, _ = fit(state, optimiser, jnp.full(3, 3.0))
    assert after.params == state.params
    # The first step of Adam is as long as the learning rate, whatever the gradient.
    first, _ = fit(start, optimiser, jnp.full(1, 3.0))
    np.testing.assert_allclose(first.params, 0.1, rtol=1e-4)


def test_the_loss_is_told_the_step_counted_from_the_start():
    optimiser = optax.sgd(0.0)
    state = supervised.start(jnp.float32(0), optimiser)
    counted = []
    for _ in range(2):
        state, steps = supervised.fit(
            state,
            lambda params, drawn, step: step.astype(jnp.float32),
            jnp.zeros(3),
            optimiser,
        )
        counted.extend(steps.tolist())
    assert counted == [0, 1, 2, 3, 4, 5]


def test_the_last_loss_tells_of_parameters_that_are_not_finite():
    # sqrt(p) at p = 0 is 0, and its slope infinite.
    optimiser = optax.sgd(0.5)
    start = supervised.start({"p": jnp.float32(0), "q": jnp.float32(0)}, optimiser)

    def loss(params, drawn, step):
        return jnp.sqrt(params["p"]) + params["q"]

    for is_finite in ([False], [True, False]):
        _, losses = supervised.fit(start, loss, jnp.zeros(len(is_finite)), optimiser)
        np.testing.assert_array_equal(np.isfinite(losses), is_finite)


def test_the_last_step_tells_of_it_also_where_a_chunk_has_more_steps_than_are_left():
    def loss(params, batch, step):
        # The value is finite, the slope of a root of zero is not.
        return batch + 0.0 * jnp.sqrt(jnp.where(step == 4, 0.0 * params, 1.0))

    optimiser = optax.sgd(0.1)
    state, told = supervised.start(jnp.float32(1), optimiser), []
    for _ in range(2):
        state, losses = supervised.fit(state, loss, jnp.ones(3), optimiser, total=5)
        told.append(losses)
    assert state.step == 5
    assert np.isnan(state.params)
    np.testing.assert_array_equal(jnp.concatenate(told)[:5], [1, 1, 1, 1, np.nan])
