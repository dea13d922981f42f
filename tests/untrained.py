"""Models that have learned nothing."""

import functools

import jax

import jaxsense
from jaxsense import Config
from jaxsense.models import Models


@functools.cache
def untrained(config: Config) -> Models:
    """Models of a key, by one program, which all tests with such networks share."""
    return jax.jit(lambda key: jaxsense.init(key, config))(jax.random.key(0))
