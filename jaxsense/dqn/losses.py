"""The temporal-difference loss of a Q-network."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxsense.core import checks


def td_error(
    q_tm1: Float[Array, "A ..."],
    a_tm1: Int[Array, "..."],
    r_t: Float[Array, "..."],
    discount_t: Float[Array, "..."],
    q_t: Float[Array, "A ..."],
) -> Float[Array, "..."]:
    """One-step Q-learning error (Mnih et al. 2015, Eq. 2) of one or many transitions.

    Args:
      q_tm1: `[A, ...]` values before the action.
      a_tm1: `[...]` int32 action.
      r_t: `[...]` reward.
      discount_t: `[...]` discount factor, 0 where the episode ended.
      q_t: `[A, ...]` the target network's values after the action; no gradient flows into them.

    Returns:
      `[...]` target minus value.
    """
    checks.require_shape("a_tm1", a_tm1, (...,))
    checks.require_shape("r_t", r_t, a_tm1.shape)
    checks.require_shape("discount_t", discount_t, a_tm1.shape)
    checks.require_shape("q_tm1", q_tm1, (None, *a_tm1.shape))
    checks.require_shape("q_t", q_t, q_tm1.shape)
    target = r_t + discount_t * jnp.max(q_t, axis=0)
    # Cheaper than indexing, whose gradient is a scatter.
    actions = jnp.arange(q_tm1.shape[0]).reshape(-1, *[1] * a_tm1.ndim)
    value = jnp.sum(jnp.where(actions == a_tm1[None], q_tm1, 0.0), axis=0)
    return jax.lax.stop_gradient(target) - value


def pseudo_huber(error: Float[Array, "..."]) -> Float[Array, "..."]:
    """`sqrt(1 + e^2) - 1`: quadratic near zero, linear far away, smooth everywhere."""
    return jnp.sqrt(1.0 + error**2) - 1.0
