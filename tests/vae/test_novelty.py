"""How much of a look is new evidence, by hand and from looks whose dependence is known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsense.vae import novelty
from jaxsense.vae.novelty import Novelty

TWO = Novelty(near=jnp.array([0.2, 0.6]), length=jnp.array([0.5, 1.0]))


def test_weights_by_hand():
    # 1 - .8 exp(-.5) for a sensor that has moved L; .2 where it stands; 1 where nobody has looked.
    found = TWO.weight(jnp.array([0.0, 0.5, jnp.inf]), 0)
    np.testing.assert_allclose(found, [0.2, 1 - 0.8 * np.exp(-0.5), 1.0], rtol=1e-6)
    np.testing.assert_allclose(TWO.weight(jnp.array(1.0), 1), 1 - 0.4 * np.exp(-0.5), rtol=1e-6)


def test_half_of_a_look_is_new_at_the_fresh_distance():
    distance = TWO.fresh_distance(0)
    # .5 sqrt(2 ln 1.6).
    np.testing.assert_allclose(distance, 0.5 * np.sqrt(2 * np.log(1.6)), rtol=1e-6)
    np.testing.assert_allclose(TWO.weight(distance, 0), 0.5, rtol=1e-6)
    # More than half is new from anywhere.
    assert TWO.fresh_distance(1) == 0


def test_independent_looks_are_new_from_anywhere():
    found = novelty.independent(3)
    assert [float(found.weight(jnp.array(d), 2)) for d in (0.0, 0.1, np.inf)] == [1, 1, 1]
    assert found.fresh_distance(2) == 0


def _pairs(key, number, share, moved):
    """Log-likelihoods of two classes in two looks whose noise has a `share` in common."""
    class_key, common_key, own_key = jax.random.split(key, 3)
    classes = jax.random.bernoulli(class_key, 0.5, (number,)).astype(jnp.int32)
    common = jax.random.normal(common_key, (number, 1))
    own = jax.random.normal(own_key, (number, 2))
    noise = jnp.sqrt(share) * common + jnp.sqrt(1 - share) * own
    # A measurement of -1 or 1 with noise of 1: the log-likelihood ratio is 2 x.
    ratio = 2 * (2.0 * classes[:, None] - 1 + noise)
    first, second = (jnp.stack([-x / 2, x / 2], axis=-1) for x in ratio.T)
    return first, second, jnp.full(number, moved), classes


def test_it_learns_that_a_repeated_look_says_nothing_and_a_distant_one_everything():
    same_key, far_key = jax.random.split(jax.random.key(0))
    # Half of the pairs from one place, with the same noise; half far apart.
    near, far = _pairs(same_key, 4000, 1.0, 0.0), _pairs(far_key, 4000, 0.0, 3.0)
    pairs = [jnp.concatenate([a, b]) for a, b in zip(near, far, strict=True)]
    first, second, moved, classes = pairs
    found, length = jax.jit(novelty.fit)(first, second, moved, classes)
    assert found < 0.15
    assert length < 3
    assert novelty.Novelty(found[None], length[None]).weight(jnp.array(3.0), 0) > 0.9


def test_it_learns_the_share_that_is_new():
    # Of equal weight, two looks would be worth 2 / 1.5 = 1.33 looks; here the first counts as 1.
    first, second, moved, classes = _pairs(jax.random.key(1), 20_000, 0.5, 0.0)
    near, _ = jax.jit(novelty.fit)(first, second, moved, classes)
    assert 0.4 < near < 0.8


@pytest.mark.parametrize(
    ("moved", "classes", "expected"),
    [
        (-1.0, 0, "moved = -1.0: must be at least 0"),
        (1.0, 2, "classes = 2: must be a whole number from 0 to 1"),
    ],
)
def test_wrong_pairs_are_refused(moved, classes, expected):
    look = jnp.zeros((1, 2))
    with pytest.raises(ValueError, match=expected):
        novelty.fit(look, look, jnp.array([moved]), jnp.array([classes]))
