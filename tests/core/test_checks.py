"""Checks of arguments, each in one line that names the argument, its value and what is right."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsense.core import checks, inside


@pytest.mark.parametrize(
    ("shape", "right", "wrong", "expected"),
    [
        ((2,), (2,), (3,), "x has the shape (3,): must be (2,)"),
        ((2,), (2,), (4, 2), "(4, 2): must be (2,); use jax.vmap for a batch"),
        ((2, None), (2, 7), (2,), "(2,): must be (2, any)"),
        ((None, 3), (0, 3), (2, 4), "(2, 4): must be (any, 3)"),
        ((3, ...), (3, 1, 4), (), "(): must be (3, ...)"),
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


@pytest.mark.parametrize("make", [jax.random.key, jax.random.PRNGKey])
def test_one_key_of_several(make):
    checks.require_key(make(0))
    checks.require_key(np.asarray(jax.random.PRNGKey(0)))  # as from a file
    with pytest.raises(ValueError, match="key = 7: must be one key"):
        checks.require_key(7)
    keys = jax.random.split(make(0), 3)
    with pytest.raises(ValueError, match=re.escape("key holds (3,) keys: must be one key")):
        checks.require_key(keys)
    jax.vmap(checks.require_key)(keys)
    jax.jit(checks.require_key)(keys[0])
    with pytest.raises(ValueError, match=r"use jax\.vmap for a batch"):
        jax.jit(checks.require_key)(keys)


@pytest.mark.parametrize("values", [3, "ab", [1.0]])
def test_one_value_for_each_modality(values):
    checks.require_one_each("x", [1.0, 2.0], ("camera", "lidar"))
    with pytest.raises(ValueError, match=r"^x .*2, one for each of \('camera', 'lidar'\)"):
        checks.require_one_each("x", values, ("camera", "lidar"))


def test_a_file_may_be_as_large_as_is_allowed(tmp_path):
    (tmp_path / "x").write_bytes(b"1234")
    assert inside.read(tmp_path / "x", most=4) == b"1234"
    with pytest.raises(OSError, match="Larger than 3 bytes"):
        inside.read(tmp_path / "x", most=3)
