"""Models that have learned nothing."""

import functools

import jax
import numpy as np

import jaxsense
from jaxsense import Config
from jaxsense.models import Models


@functools.cache
def untrained(config: Config) -> Models:
    """Models of a key, by one program, which all tests with such networks share."""
    return jax.jit(lambda key: jaxsense.init(key, config))(jax.random.key(0))


@functools.cache
def blank(config: Config) -> Models:
    """Models whose numbers are all 0: nothing is compiled."""
    shapes = jax.eval_shape(lambda key: jaxsense.init(key, config), jax.random.key(0))
    return jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), shapes)
