"""The supervised fit, on losses whose descent is known."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxsense.core import supervised

KEY = jax.random.key(0)


@dataclasses.dataclass(frozen=True)
class Given:
    """A problem whose batches are given, one for each step of a call."""

    loss: Callable[..., jax.Array]
    batches: Any
    steps: int
    learning_rate: float = 0.1

    def draw(self, key, number):
        del key
        return jnp.array(self.batches)[:number]


def fit(state, problem):
    return supervised.fit(KEY, state, problem, len(problem.batches))


start = supervised.start


def square(params, batch, step):
    del step
    return 0.5 * (params - batch) ** 2


def test_steps_of_adam_along_a_cosine_as_worked_by_hand():
    # With slopes 3 and 5 the first step of Adam is as long as the learning rate, .1. In the second
    # the mean slope is (.9 x .1 x 3 + .1 x 5) / .19 = 4.052632, the mean square
    # (.999 x .001 x 9 + .001 x 25) / .001999 = 17.004002: .982792 of .1 (1 + cos(pi / 4)) / 2.
    problem = Given(lambda params, slope, step: slope * params, [3.0, 5.0], 4)
    state, losses = fit(start(jnp.float32(2), problem), problem)
    np.testing.assert_allclose(losses, [6.0, 9.5], rtol=1e-6)  # 3 x 2; 5 x 1.9
    np.testing.assert_allclose(state.params, 1.9 - 0.0853553 * 0.982792, rtol=1e-6)
    np.testing.assert_allclose(state.loss, 7.75, rtol=1e-6)
    assert state.step == 2


def test_chunks_go_on_where_the_last_one_stopped():
    whole, half = Given(square, [3.0] * 6, 6), Given(square, [3.0] * 3, 6)
    first = start(jnp.float32(0), whole)
    assert np.isinf(first.loss)
    after, losses = fit(first, whole)
    middle, early = fit(first, half)
    chunked, late = fit(middle, half)
    assert (first.step, middle.step, chunked.step, after.step) == (0, 3, 6, 6)
    np.testing.assert_allclose(chunked.params, after.params, rtol=1e-6)
    np.testing.assert_allclose(jnp.concatenate([early, late]), losses, rtol=1e-6)
    np.testing.assert_allclose(chunked.loss, late.mean(), rtol=1e-6)


def test_the_last_chunk_makes_no_step_too_many():
    # Five steps in chunks of two: the sixth step is none, and its loss does not count.
    problem = Given(lambda params, batch, step: params + step, [0.0] * 2, 5)
    states = [start(jnp.float32(1), problem)]
    for _ in range(3):
        states.append(fit(states[-1], problem)[0])
    assert [int(state.step) for state in states] == [0, 2, 4, 5]
    one, losses = fit(states[2], Given(problem.loss, [0.0], 5))
    assert losses[0] == states[2].params + 4  # steps are counted from the start
    assert one.params == states[3].params != states[2].params
    np.testing.assert_allclose(states[3].loss, losses[0], rtol=1e-6)


def test_the_last_step_tells_of_it_also_where_a_chunk_has_more_steps_than_are_left():
    def loss(params, batch, step):
        # The value is finite, the slope of a root of zero is not.
        return batch + 0.0 * jnp.sqrt(jnp.where(step == 4, 0.0 * params, 1.0))

    problem = Given(loss, [1.0] * 3, 5)
    state, told = start(jnp.float32(1), problem), []
    for _ in range(2):
        state, losses = fit(state, problem)
        told.append(losses)
    assert state.step == 5
    assert np.isnan(state.params)
    assert np.isnan(state.loss)
    np.testing.assert_array_equal(jnp.concatenate(told)[:5], [1, 1, 1, 1, np.nan])
