"""Minibatch training, on losses whose descent is known."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from jaxsense import training


def fit(key, state, optimiser, steps, noise=0.0):
    """Fits p to batches around 3 with the loss (p - batch)^2 / 2."""
    return training.fit(
        key,
        state,
        lambda key, params, batch, step: 0.5 * (params - batch) ** 2,
        lambda key: 3.0 + noise * jax.random.normal(key),
        optimiser,
        steps,
    )


def test_steps_of_gradient_descent_as_worked_by_hand():
    # p <- p - .5 (p - 3): 0, 1.5, 2.25; the losses before each step are 9/2 and 2.25/2.
    optimiser = optax.sgd(0.5)
    state, losses = fit(jax.random.key(0), training.start(jnp.float32(0), optimiser), optimiser, 2)
    np.testing.assert_allclose(state.params, 2.25)
    np.testing.assert_allclose(losses, [4.5, 1.125])
    assert state.step == 2


def test_chunks_go_on_where_the_last_one_stopped():
    optimiser = training.adam(0.1, 6)
    start = training.start(jnp.float32(0), optimiser)
    whole, losses = fit(jax.random.key(0), start, optimiser, 6)
    half, first = fit(jax.random.key(1), start, optimiser, 3)
    chunked, second = fit(jax.random.key(2), half, optimiser, 3)
    assert (start.step, half.step, chunked.step, whole.step) == (0, 3, 6, 6)
    np.testing.assert_allclose(chunked.params, whole.params, rtol=1e-6)
    np.testing.assert_allclose(jnp.concatenate([first, second]), losses, rtol=1e-6)


def test_adam_comes_to_rest_at_the_last_step():
    optimiser = training.adam(0.1, 6)
    state, _ = fit(jax.random.key(0), training.start(jnp.float32(0), optimiser), optimiser, 6)
    after, _ = fit(jax.random.key(1), state, optimiser, 3)
    assert after.params == state.params
    # The first step of Adam is as long as the learning rate, whatever the gradient.
    first, _ = fit(jax.random.key(0), training.start(jnp.float32(0), optimiser), optimiser, 1)
    np.testing.assert_allclose(first.params, 0.1, rtol=1e-4)


def test_the_same_key_gives_the_same_training():
    optimiser = optax.sgd(0.5)
    start = training.start(jnp.float32(0), optimiser)
    runs = [fit(jax.random.key(k), start, optimiser, 5, noise=1.0) for k in (0, 0, 1)]
    np.testing.assert_array_equal(runs[0][1], runs[1][1])
    assert np.all(runs[0][1] != runs[2][1])


@pytest.mark.parametrize("part", ["batch", "loss"])
def test_every_step_draws_anew(part):
    optimiser = optax.sgd(0.0)
    _, drawn = training.fit(
        jax.random.key(0),
        training.start(jnp.float32(0), optimiser),
        lambda key, params, batch, step: batch if part == "batch" else jax.random.uniform(key),
        jax.random.uniform,
        optimiser,
        20,
    )
    assert len(np.unique(drawn)) == 20


def test_the_loss_is_told_the_step_counted_from_the_start():
    optimiser = optax.sgd(0.0)
    state = training.start(jnp.float32(0), optimiser)
    counted = []
    for _ in range(2):
        state, steps = training.fit(
            jax.random.key(0),
            state,
            lambda key, params, batch, step: step.astype(jnp.float32),
            lambda key: None,
            optimiser,
            3,
        )
        counted.extend(steps.tolist())
    assert counted == [0, 1, 2, 3, 4, 5]
