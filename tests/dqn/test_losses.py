"""The temporal-difference loss, by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsense.dqn import losses

Q_TM1, Q_T = jnp.array([1.0, 2.0, 3.0]), jnp.array([-1.0, 4.0, 0.0])


def td_error(q_tm1, q_t, action=1, discount=0.9):
    return losses.td_error(q_tm1, jnp.int32(action), jnp.float32(0.5), jnp.float32(discount), q_t)


def test_td_error_as_worked_by_hand():
    # .5 + .9 x max(-1, 4, 0) - 2 = 2.1; for action 2, .5 + 3.6 - 3 = 1.1.
    np.testing.assert_allclose(td_error(Q_TM1, Q_T), 2.1, rtol=1e-6)
    np.testing.assert_allclose(td_error(Q_TM1, Q_T, action=2), 1.1, rtol=1e-6)


def test_td_error_does_not_look_beyond_the_end():
    np.testing.assert_allclose(td_error(Q_TM1, Q_T, discount=0.0), -1.5)  # .5 - 2


def test_no_gradient_flows_into_the_target():
    by_value, by_target = jax.grad(td_error, argnums=(0, 1))(Q_TM1, Q_T)
    np.testing.assert_array_equal(by_value, [0.0, -1.0, 0.0])
    np.testing.assert_array_equal(by_target, [0.0, 0.0, 0.0])


def test_td_errors_of_many_transitions_are_those_of_each():
    keys = jax.random.split(jax.random.key(0), 4)
    q_tm1, q_t = jax.random.normal(keys[0], (2, 3, 7))
    actions = jax.random.randint(keys[1], (7,), 0, 3)
    rewards, discounts = jax.random.uniform(keys[2], (2, 7))
    together = losses.td_error(q_tm1, actions, rewards, discounts, q_t)
    for i in range(7):
        alone = losses.td_error(q_tm1[:, i], actions[i], rewards[i], discounts[i], q_t[:, i])
        np.testing.assert_allclose(together[i], alone, rtol=1e-6)


def test_values_of_other_transitions_than_the_actions_raise():
    with pytest.raises(ValueError, match="q_tm1 has the shape"):
        td_error(Q_TM1[:, None], Q_T)


def test_pseudo_huber_as_worked_by_hand():
    # sqrt(1 + 9/16) - 1 = 5/4 - 1; sqrt(1 + 576/49) - 1 = 25/7 - 1.
    errors = jnp.array([0.0, 0.75, -0.75, 24 / 7])
    np.testing.assert_allclose(losses.pseudo_huber(errors), [0, 0.25, 0.25, 18 / 7], rtol=1e-6)


def test_pseudo_huber_has_a_bounded_slope():
    # e / sqrt(1 + e^2): .75 / 1.25 = .6, and almost 1 far out.
    slopes = jax.vmap(jax.grad(losses.pseudo_huber))(jnp.array([0.0, 0.75, 1000.0]))
    np.testing.assert_allclose(slopes, [0.0, 0.6, 1.0], rtol=1e-5)
