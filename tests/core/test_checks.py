"""Checks of arguments, each in one line that names the argument, its value and what is right."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsense import vae
from jaxsense.core import checks


@pytest.mark.parametrize(
    ("shape", "right", "wrong", "expected"),
    [
        ((2,), (2,), (3,), "x has the shape (3,): must be (2,)"),
        ((2,), (2,), (4, 2), "(4, 2): must be (2,); use jax.vmap for a batch"),
        ((2, None), (2, 7), (2,), "(2,): must be (2, any)"),
        ((None, 3), (0, 3), (2, 4), "(2, 4): must be (any, 3)"),
        ((None, 3), (5, 3), (4, 5, 3), "must be (any, 3); use jax.vmap for a batch"),
        ((), (), (1,), "(1,): must be (); use jax.vmap for a batch"),
        ((3, ...), (3,), (2,), "(2,): must be (3, ...)"),
        ((3, ...), (3, 1, 4), (), "(): must be (3, ...)"),
        ((..., None), (1, 2), (), "(): must be (..., any)"),
        ((..., 2), (5, 2), (2, 5), "(2, 5): must be (..., 2)"),
    ],
)
def test_shapes(shape, right, wrong, expected):
    checks.require_shape("x", np.zeros(right), shape)
    with pytest.raises(ValueError, match=re.escape(expected) + "$"):
        checks.require_shape("x", np.zeros(wrong), shape)
    jax.eval_shape(lambda x: checks.require_shape("x", x, shape), jnp.zeros(right))
    with pytest.raises(ValueError, match=re.escape(expected)):
        jax.eval_shape(lambda x: checks.require_shape("x", x, shape), jnp.zeros(wrong))


def test_a_number_has_no_axes_and_a_list_is_no_array():
    checks.require_shape("x", 1, ())
    checks.require_shape("x", np.float32(1), ())
    with pytest.raises(ValueError, match=re.escape("x has the shape (): must be (2,)")):
        checks.require_shape("x", 1.0, (2,))
    for wrong in ([0.0, 1.0], None, "ab"):
        expected = re.escape(f"x = {wrong!r}: must be an array of shape (2,)")
        with pytest.raises(ValueError, match=expected):
            checks.require_shape("x", wrong, (2,))


def test_the_shape_of_a_jmvae_is_made_of_tuples():
    given = {"modalities": ("a",), "feature_sizes": (2,), "latent_size": 2, "hidden": (4,)}
    hash(vae.Jmvae(**given))
    for name in ("modalities", "feature_sizes", "hidden"):
        of_lists = {**given, name: [*given[name]]}
        with pytest.raises(ValueError, match=re.escape(f"{name} = {of_lists[name]}: must be a")):
            vae.Jmvae(**of_lists)
