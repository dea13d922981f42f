"""How much of a look is new evidence, by hand and from looks whose dependence is known."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsense.core import novelty
from jaxsense.core.novelty import Novelty

TWO = Novelty(strength=jnp.array([1.0, 0.3]), length=jnp.array([0.5, 1.0]))
NONE = np.inf
to_go = jax.jit(lambda apart: TWO.to_go(apart, 0))


def test_weights_by_hand():
    # Nobody has looked: 1. One look from there: 1 / 2^2. Two: 1 / 3^2. One from .5 m, L, away:
    # (1 + exp(-.5))^-2.
    apart = jnp.array([[NONE, NONE], [0.0, NONE], [0.0, 0.0], [NONE, 0.5]])
    expected = [1.0, 1 / 4, 1 / 9, (1 + np.exp(-0.5)) ** -2]
    np.testing.assert_allclose(TWO.weight(apart, 0), expected, rtol=1e-6)
    np.testing.assert_allclose(TWO.weight(jnp.zeros(1), 1), 1.3**-2, rtol=1e-6)


@pytest.mark.parametrize("number", [1, 2, 5])
def test_half_of_a_look_is_new_at_the_end_of_the_way(number):
    there = np.where(np.arange(5) < number, 0.0, NONE).astype(np.float32)
    way = np.asarray(to_go(there))
    np.testing.assert_allclose(TWO.weight(there + way, 0), 0.5, rtol=1e-5)
    # It is as much shorter as the robot has gone already.
    np.testing.assert_allclose(to_go(there + np.float32(0.2)), way - 0.2, rtol=1e-5)
    assert to_go(there + way + np.float32(1e-3)) == 0


fit = jax.jit(novelty.fit)


@functools.partial(jax.jit, static_argnums=1)
def _looks(key, number, share, apart):
    """Log-likelihoods of two classes in four looks whose noise has a `share` in common."""
    class_key, common_key, own_key = jax.random.split(key, 3)
    classes = jax.random.bernoulli(class_key, 0.5, (number,)).astype(jnp.int32)
    common = jax.random.normal(common_key, (number, 1))
    own = jax.random.normal(own_key, (number, 4))
    noise = jnp.sqrt(share) * common + jnp.sqrt(1 - share) * own
    # A measurement of -1 or 1 with noise of 1: the log-likelihood ratio is 2 x.
    ratio = 2 * (2.0 * classes[:, None] - 1 + noise)
    positions = apart * jnp.stack([jnp.arange(4.0), jnp.zeros(4)], axis=-1)
    found = jnp.stack([-ratio / 2, ratio / 2], axis=-1)
    return found, jnp.broadcast_to(positions, (number, 4, 2)), classes


def test_it_learns_the_share_that_looks_have_in_common():
    # Four looks that share half of their noise are worth 4 / 2.5 = 1.6.
    found, positions, classes = _looks(jax.random.key(1), 4000, 0.5, 0.0)
    strength, length = fit(found, positions, classes)
    apart = jnp.where(np.tri(4, k=-1, dtype=bool), 0.0, NONE)
    worth = jnp.sum(Novelty(strength[None], length[None]).weight(apart, 0))
    assert worth == pytest.approx(1.6, abs=0.3)
